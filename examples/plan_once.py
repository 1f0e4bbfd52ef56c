"""Plan once from a point cloud and a state. Needs only the package aero-planner."""

import numpy as np

from aero_planner import Goal, Planner, PlannerConfig, PlanStatus, VehicleState

# A pole of radius 0.2 m that stands 4 m ahead, as points in the world frame (x forward, y left, z up) [m].
angle, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 40), np.linspace(0.0, 4.0, 40))
pole = np.stack((4.0 + 0.2 * np.cos(angle), 0.2 * np.sin(angle), height), axis=-1).reshape(-1, 3)

planner = Planner(PlannerConfig(), device="cpu", seed=0)
state = VehicleState(
    position=[0.0, 0.0, 2.0],
    velocity=[3.0, 0.0, 0.0],
    quaternion=[1.0, 0.0, 0.0, 0.0],  # w x y z, body to world
)
plan = planner.plan(state, Goal([20.0, 0.0, 2.0]), pole.astype(np.float32), ground_height=0.0)

thrust, *rates = plan.command[0]
chosen = f"instance {plan.best}, {plan.kinds[plan.best]}"
print(f"{PlanStatus(plan.status).name}: {len(plan.kinds)} candidates, chosen: {chosen}")
print(f"first command: {thrust:.2f} N, {np.round(rates, 2)} rad/s")
print(f"closest to the pole: {plan.clearance[plan.best].min():.2f} m")
