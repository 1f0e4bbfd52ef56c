"""The mission of a simulated flight: it gives the simulator one goal after another."""

from __future__ import annotations

import dataclasses

import numpy as np

from aero_planner import VehicleState
from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission, Position
from aero_viz.flight.explanation import obstruction
from aero_viz.flight.metrics import FlightResult
from aero_viz.flight.simulator import Simulator
from aero_viz.scenes.world import World


class FlownMission:
    """Follows the true state of a drone along a mission.

    Args:
        simulator: simulator of the one flight, whose goal is the first of the world's route.
        world: its world.

    Attributes:
        progress: present progress, which a checkpoint holds; see `restore`.
    """

    def __init__(self, simulator: Simulator, world: World) -> None:
        self.progress = MissionProgress(world.route)
        self._simulator = simulator
        self._known: tuple[Position, bool] | None = (self.goal, True)
        """Goal of the simulator, and whether it is the last one; None if the simulator must be told."""
        self._tell()

    @property
    def goal(self) -> Position:
        """Present goal [m], world frame."""
        return self.progress.goal(self._simulator.time)

    @property
    def _is_last(self) -> bool:
        return self.progress.is_last and not self.progress.is_moving(self._simulator.time)

    def begin(self, mission: Mission, *, resume: bool = False) -> None:
        """Fly another mission from here. A flight that has arrived, stalled or run out of time continues.

        Args:
            mission: the mission.
            resume: see `MissionProgress.changed`; otherwise, it is flown from its first waypoint on.
        """
        time = self._simulator.time
        fresh = MissionProgress(mission, since=time, nearest_time=time)
        self.progress, self._known = self.progress.changed(mission, time) if resume else fresh, None
        self._tell()

    def restore(self, progress: MissionProgress) -> None:
        """Continue from the progress of a checkpoint to which the simulator has returned."""
        self.progress = progress
        self._known = self.goal, self._is_last

    def jump(self) -> None:
        """Fly on after the drone was put somewhere else."""
        self.progress = self.progress.jump(self._simulator.time)
        self._tell()

    def follow(self, state: VehicleState, world: World, *, outcome: str | None) -> None:
        """Take a tick into the mission. The rules of the flight end the last leg.

        Args:
            state: true state after the tick.
            world: where it is flown.
            outcome: outcome of the flight after the tick.
        """
        time, radius = self._simulator.time, self._simulator.rules.radius
        if outcome == "arrived":
            self.progress = self.progress.arrive(time, state.position)
        elif outcome is None and self._is_last:
            self._tell()  # a goal that moved has stopped
        elif outcome is None:

            def obstacle(place: Position, waypoint: Position) -> str | None:
                return obstruction(world.at(time), place, waypoint, radius=radius)

            speed = float(np.linalg.norm(state.velocity))
            self.progress = self.progress.advance(time, state.position, speed, obstacle=obstacle)
            self._tell()

    def complete(self, result: FlightResult) -> FlightResult:
        """Return the result of the flight with what became of the waypoints, if there are several."""
        mission, events = self.progress.mission, self.progress.events
        if len(mission) == 1:
            return result
        given_up = [event.text for event in events if event.kind == "given_up"]
        return dataclasses.replace(
            result,
            explanation=" ".join(filter(None, [*given_up, result.explanation])) or None,
            waypoints=len(mission),
            waypoints_passed=self.progress.passed,
        )

    def _tell(self) -> None:
        """Give the simulator the goal if it has changed."""
        goal = self.goal, self._is_last
        if goal != self._known:
            self._known = goal
            self._simulator.set_goal([goal[0]], is_last=goal[1])
