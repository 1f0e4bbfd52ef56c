"""One closed-loop flight as a source for the engine: the dashboard's drone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner import Goal, Plan, PlannerConfig, VehicleState
from aero_viz.errors import UserError
from aero_viz.flight.batch import SWEEPS
from aero_viz.flight.estimate import StateNoise
from aero_viz.flight.metrics import FlightResult, flight_results
from aero_viz.flight.simulator import FlightRules, Simulator
from aero_viz.flight.vehicle import VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.lidar import LidarModel, livox_mid360
from aero_viz.source import Observation, Scenery

__all__ = ["FlightSource"]

Cloud = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _Checkpoint:
    simulator: tuple[int, list[NDArray[Any]]]
    sweeps: tuple[Cloud, ...]
    parts: tuple[Cloud, ...]
    goal: NDArray[np.float64]


class FlightSource:
    """A simulated flight in a world; implements `aero_viz.source.Source`.

    Args:
        world: where to fly.
        lidar: None is the Livox Mid-360.
        vehicle: None is the default vehicle.
        rules: when the flight ends; a tick of the source is the time of one plan, `ticks_per_plan` ticks of the rules.
        noise: of the state estimate; None shows the planner the true state.
        control_step: dt of the plans' controls, which are interpolated where a plan is flown for several ticks [s].
        seed: of the LiDAR's pattern and of all noise; same seed, device and plans: same flight, bit for bit.
        device: Warp device.

    Raises:
        UserError: the tick does not divide the LiDAR's sweep.
    """

    closed_loop = True
    times = None

    def __init__(
        self,
        world: World,
        *,
        lidar: LidarModel | None = None,
        vehicle: VehicleModel | None = None,
        rules: FlightRules | None = None,
        noise: StateNoise | None = None,
        control_step: float = 0.05,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        rules = rules or FlightRules()
        try:
            self._simulator = Simulator(
                [world],
                lidar=lidar or livox_mid360(),
                vehicle=vehicle or VehicleModel.from_config(PlannerConfig()),
                rules=rules,
                seeds=[seed],
                device=device,
                noise=noise,
            )
        except ValueError as error:
            raise UserError(f"Cannot fly {world.name!r}: {error}") from error
        self.name = world.name
        self.period = rules.period * rules.ticks_per_plan
        self._phases = [k * rules.period / control_step for k in range(int(rules.ticks_per_plan))]
        self.scenery = Scenery(start=world.start, world=world)
        self._seed = seed
        self._goal = world.goal
        self._parts: tuple[Cloud, ...] = ()  # of the sweep in progress
        sweeps = []
        for sweep in range(-SWEEPS, 0):
            self._simulator.look(sweep)
            sweeps.append(_returns([self._new_points(0, None)]))
        self._show(tuple(sweeps))
        self._read_state()

    @property
    def simulator(self) -> Simulator:
        """The simulator behind the source."""
        return self._simulator

    def observe(self) -> Observation:
        """Return what the planner sees now, the estimated state and the last 10 whole sweeps, and the true state."""
        return self._observation

    def advance(self, plan: Plan) -> None:
        """Fly the first controls of `plan` for the time of one plan; does nothing when the flight is over."""
        commands = wp.array(plan.command[None], dtype=wp.vec4, device=self._simulator.device)
        for phase in self._phases:
            if self.outcome is not None:
                return
            _, first, end = self._simulator.advance(commands, phase=phase)
            self._parts = (*self._parts, self._new_points(first, end))
            if end == self._simulator.lidar.model.points_per_sweep:
                self._show((*self._sweeps[1:], _returns(self._parts)))
                self._parts = ()
            self._read_state()

    def checkpoint(self) -> object:
        """Return all that `restore` needs; clouds are shared with the source, not copied."""
        return _Checkpoint(self._simulator.checkpoint(), self._sweeps, self._parts, self._goal)

    def restore(self, checkpoint: object) -> None:
        """Continue from a checkpoint of this source: the same plans give the same flight, bit for bit.

        Raises:
            TypeError: this is no checkpoint of a flight.
        """
        if not isinstance(checkpoint, _Checkpoint):
            raise TypeError(f"{type(checkpoint).__name__} is no checkpoint of a flight.")
        self._simulator.restore(checkpoint.simulator)
        self._goal, self._parts = checkpoint.goal, checkpoint.parts
        self._show(checkpoint.sweeps)
        self._read_state()

    def seek(self, time: float) -> None:
        """A flight cannot be sought, only restored.

        Raises:
            TypeError: always.
        """
        raise TypeError("a flight has no time line to seek in; restore one of its checkpoints.")

    def set_goal(self, position: ArrayLike) -> None:
        """Move the goal to `position` [m], shape [3], world frame; a flight that arrived or stalled goes on.

        Raises:
            UserError: the position is not three finite numbers.
        """
        goal = np.array(position, dtype=np.float64)
        if goal.shape != (3,) or not np.isfinite(goal).all():
            raise UserError(f"The goal {np.asarray(position).tolist()} is no position; give three finite numbers.")
        goal.flags.writeable = False
        self._goal = goal
        self._simulator.set_goal(goal[None])
        self._read_state()

    def result(self) -> FlightResult:
        """Return the metrics of the flight so far."""
        return flight_results(
            self._simulator.records(),
            [self.outcome],
            period=self._simulator.rules.period,
            seeds=[self._seed],
            scenes=[self.name],
            configs=[""],
            plan_ms=None,
        )[0]

    def close(self) -> None:
        """Nothing to release: device memory goes with the source."""

    def _read_state(self) -> None:
        simulator, vehicle = self._simulator, self._simulator.vehicle

        def state_of(holder: Any) -> VehicleState:
            arrays = (holder.position, holder.velocity, holder.quaternion, vehicle.acceleration)
            return VehicleState(*(array.numpy()[0].astype(np.float64) for array in arrays), time=simulator.time)

        self.outcome: str | None = simulator.outcomes()[0]
        self._observation = Observation(
            time=simulator.time,
            state=state_of(simulator.estimate),
            goal=Goal(self._goal),
            points=self._points,
            sweep_count=len(self._sweeps),
            true_state=state_of(vehicle),
        )

    def _new_points(self, first: int, end: int | None) -> Cloud:
        points: Any = self._simulator.lidar.points.numpy()
        return points[0, first:end].copy()

    def _show(self, sweeps: tuple[Cloud, ...]) -> None:
        self._sweeps = sweeps
        self._points = np.concatenate(sweeps)
        self._points.flags.writeable = False


def _returns(parts: Sequence[Cloud]) -> Cloud:
    """Join the parts of a sweep and leave out the rays without return."""
    points: Any = np.concatenate(parts)
    return points[~np.isnan(points[:, 0])]
