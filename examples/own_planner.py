"""Write your own planner: it flies to the side on which the points leave more room. Its parameters become sliders.

`aero-viz demo forest --planner examples.own_planner:Sidestep --speed 2` flies it on the page.
"""

from dataclasses import dataclass, field

import numpy as np

from aero_planner.parameters import ParameterSection, live
from aero_viz.flight import fly
from aero_viz.planners import CandidatePlan, DroneConfig, Observation, Planner
from aero_viz.scenes import scene

STEP = 0.1  # [s]


@dataclass(frozen=True)
class Sides(ParameterSection, section="sides"):
    """Sides: which directions are tried."""

    width: float = live(120.0, "deg", 10.0, 300.0, "Angle between the outermost directions.", basic=True)
    radius: float = live(0.7, "m", 0.1, 3.0, "Room that a path needs on all sides.", basic=True)


@dataclass(frozen=True)
class Config(DroneConfig):
    """The drone and the sides."""

    sides: Sides = field(default_factory=Sides)


class Sidestep(Planner):
    """Tries straight paths at several angles, and flies the one that is nearest to the goal and free."""

    Config = Config

    def plan(self, observation: Observation) -> CandidatePlan:
        sides, speed = self.config.sides, self.config.vehicle.speed_limit
        state, sought = observation.state, observation.goal.position
        position, velocity, goal = (np.asarray(value, float) for value in (state.position, state.velocity, sought))
        ahead = np.arctan2(*(goal - position)[1::-1])
        angles = ahead + np.radians(sides.width) * np.linspace(-0.5, 0.5, 21)
        directions = np.stack((np.cos(angles), np.sin(angles), np.full(21, 0.2 * (goal - position)[2])), axis=1)
        paths = position + speed * STEP * np.arange(21)[:, None] * directions[:, None]
        points = observation.points[np.isfinite(observation.points).all(axis=1)][::20]
        points = points[(np.linalg.norm(points - position, axis=1) < 8.0) & (np.abs(points - position)[:, 2] < 1.0)]
        gaps = np.linalg.norm(paths[:, 1:, None] - points, axis=-1).min(axis=-1, initial=5.0)
        costs = {"goal": np.linalg.norm(paths[:, -1] - goal, axis=1)}
        costs["obstacles"] = 100.0 * np.clip(sides.radius - gaps, 0.0, None).max(axis=1)
        best = int(np.sum(list(costs.values()), axis=0).argmin())
        pull = 1.5 * (speed * directions[best] - velocity)  # acceleration toward the velocity along the path
        return CandidatePlan(paths, costs, best, STEP, controls=np.tile([*pull, 0.0], (20, 1)), clearance=gaps)


if __name__ == "__main__":
    result = fly(scene("forest", seed=1), config=Config(), speed=2.0)
    print(f"sidestep: {result.reason} after {result.flight_time_s:.1f} s, {result.min_clearance:.2f} m from the trees")
