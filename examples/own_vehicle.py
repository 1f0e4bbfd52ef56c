"""Fly a heavier drone with lags, drag and wind, with a planner that does not know its mass and one that does."""

from aero_planner import PlannerConfig
from aero_viz.flight import StateNoise, VehicleModel, fly
from aero_viz.scenes import scene

# The simulated drone. Response times are those that PX4 was measured to have.
drone = VehicleModel(
    mass=1.3,
    thrust_max=25.0,
    thrust_lag=0.04,  # [s]
    rate_lag=0.07,  # [s]
    latency=0.02,  # [s]
    drag=0.3,  # [1/s]
    gust_speed=1.0,  # [m/s]
)
noise = StateNoise(position=0.03, velocity=0.05, attitude=0.5)  # of the state estimate [m], [m/s], [deg]
world = scene("random_clutter", seed=3)

# The planner's own model of the drone: by default it has a mass of 1 kg and no lags.
configs = {
    "default": PlannerConfig(),
    "matched": PlannerConfig().replace({"vehicle.mass": 1.3, "vehicle.thrust_max": 25.0}),
}
for name, config in configs.items():
    result = fly(world, config=config, vehicle=drone, noise=noise, seed=3)
    print(
        f"{name}: {result.reason} after {result.flight_time_s:.1f} s, clearance at least {result.min_clearance:.2f} m"
    )
