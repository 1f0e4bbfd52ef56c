"""Write your own source for a session: a ball crosses the path of a drone that follows its plan exactly."""

from typing import Any

import numpy as np

from aero_planner import Goal, Sweeps, VehicleState
from aero_viz.planners import Plan
from aero_viz.session import Session
from aero_viz.session.source import Observation, SourceInfo

BALL = np.random.default_rng(0).normal(size=(2000, 3))
BALL /= np.linalg.norm(BALL, axis=1, keepdims=True)  # points on a ball of radius 1 m


class CrossingBall:
    """A `Source`. Its state is an immutable tuple, which also serves as the checkpoint."""

    def __init__(self) -> None:
        start, goal = np.array([0.0, 0.0, 2.0]), np.array([20.0, 0.0, 2.0])
        self.info = SourceInfo(name="crossing ball", closed_loop=True, period=0.05, start=start)
        self.explanation = None
        self._state: Any = 0, goal, start, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])  # tick, goal, p, v, q

    @property
    def outcome(self) -> str | None:
        return "arrived" if np.linalg.norm(self._state[2] - self._state[1]) < 1.0 else None

    def observe(self) -> Observation:
        tick, goal, *state = self._state
        time = tick * self.info.period
        points = BALL + np.array([10.0, 4.5 - 2.0 * time, 2.0])
        return Observation(time, VehicleState(*state), Goal(goal), Sweeps([points.astype(np.float32)]))

    def advance(self, plan: Plan) -> None:
        tick, goal, *_ = self._state
        rollout = plan.positions, plan.velocities, plan.quaternions
        self._state = (tick + 1, goal, *(array[plan.best, 1] for array in rollout))

    def checkpoint(self) -> object:
        return self._state

    def restore(self, checkpoint: object) -> None:
        self._state = checkpoint

    def set_goal(self, position: np.ndarray) -> None:
        self._state = (self._state[0], np.asarray(position), *self._state[2:])

    def seek(self, time: float) -> None: ...  # for recordings only

    def close(self) -> None: ...


session = Session(CrossingBall())
frame = session.tick()
while frame.outcome is None:
    frame = session.tick()
print(f"{frame.source.name}: {frame.outcome} after {frame.time:.1f} s")
session.close()
