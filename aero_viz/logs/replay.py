"""A flight log as a source: the recorded motion, goal, plans and outcome, as they were."""

from __future__ import annotations

import bisect
import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlanStatus
from aero_planner.mission_progress import MissionProgress
from aero_viz.errors import UserError
from aero_viz.logs.log_contents import LogContents, read_log
from aero_viz.reader_process import ReadCancelled, Reader
from aero_viz.recordings.recording import Recording
from aero_viz.recordings.source import RecordingSource
from aero_viz.scenes import World
from aero_viz.session.source import Observation, RecordedPlan


class FlightReplay(RecordingSource):
    """Replays a flight log. The planner runs on it as on any recording, and the recorded plans are shown as well.

    Damaged plans are left out; a notice of the source says so.

    Args:
        recording: the log; `close` closes it.
        path: file of the log.
        goal_ahead: distance of the goal along the recorded path [m], where no goal is recorded.
        read: reads the log; None starts a process for it.
    """

    def __init__(
        self, recording: Recording, path: str | Path, *, goal_ahead: float = 15.0, read: Reader | None = None
    ) -> None:
        if recording.poses is not None:
            recording.poses = recording.poses.without_offset()  # the goals, plans and world are in the recorded frame
        super().__init__(recording, goal_ahead=goal_ahead)
        poses = recording.poses
        self.start = 0.0 if poses is None else float(poses.times[0])
        """Source time of the first pose [s]."""
        self._goals: list[tuple[float, NDArray[np.float64]]] = []
        self._plans: list[RecordedPlan] = []
        self._world: World | None = None
        self._changes: list[tuple[float, World]] = []
        """Times of changes of the world [s], and the world from then on."""
        self._legs: list[tuple[float, MissionProgress]] = []
        """Times at which legs of the mission begin [s], and the progress from then on."""
        self._ending = ""
        settings: dict[str, Any] = {}
        notices = [
            "Recorded flight: motion, clouds, goal and the recorded plan are those of the log; anchors, guides and "
            "rollouts are planned now on these clouds, and are not flown."
        ]
        try:
            contents = read_log(path, read)
            self._use(contents)
            notices += [contents.damage] if contents.damage else []
            self._legs = [(self._source_time(contents, stamp), leg) for stamp, leg in contents.legs()]
            self._world, settings = contents.world(), contents.settings()
        except ReadCancelled:
            raise
        except UserError as error:
            notices.append(f"{error} What can be read is shown.")
        self._plan_times = [plan.time for plan in self._plans]
        notices[0] += f" {self._ending}" if self._ending else ""
        self.info = dataclasses.replace(
            self.info,
            world=self._world,
            settings=settings,
            recorded_plan=self._plan_at if self._plans else None,
            notices=(*notices, *recording.problems),
        )

    def observe(self) -> Observation:
        """Return the planner's input at this tick."""
        observation = super().observe()
        row = bisect.bisect_right(self._legs, observation.time + 1e-6, key=lambda leg: leg[0]) - 1
        if self._legs:
            observation = dataclasses.replace(observation, mission=self._legs[max(row, 0)][1])
        if self._world is None:
            return observation
        # The log of a simulated flight: a sweep without points is one in the open.
        row = bisect.bisect_right(self._changes, observation.time + 1e-6, key=lambda change: change[0]) - 1
        world = self._changes[row][1] if row >= 0 else self._world
        return dataclasses.replace(observation, ground_height=world.ground_height, world=world, empty_is_clear=True)

    @property
    def explanation(self) -> str | None:
        """Outcome of the recorded flight, once its end is reached, and the sweeps found to be unreadable so far."""
        sentences = [self._ending if self.outcome is not None else "", super().explanation or ""]
        return " ".join(sentence for sentence in sentences if sentence) or None

    def _recorded_goal(self, time: float) -> NDArray[np.float64] | None:
        row = bisect.bisect_right(self._goals, time + 1e-6, key=lambda entry: entry[0]) - 1
        return self._goals[max(row, 0)][1] if self._goals else None

    def _plan_at(self, time: float) -> RecordedPlan | None:
        row = bisect.bisect_right(self._plan_times, time + 1e-6) - 1
        return self._plans[row] if row >= 0 else None

    def _source_time(self, contents: LogContents, stamp: int) -> float:
        first = contents.pose_stamps[0] if contents.pose_stamps else stamp
        return (stamp - first) * 1e-9 + self.start

    def _use(self, contents: LogContents) -> None:
        """Use the outcome, the goals and the plans of the log."""
        if contents.outcome:
            self._ending = f"It ended with: {contents.outcome.replace('_', ' ')}. {contents.explanation}".strip()
        source_time = partial(self._source_time, contents)
        self._goals = [(source_time(stamp), place) for stamp, place in contents.goals]
        self._plans = [
            RecordedPlan(
                time=source_time(plan.stamp),
                path=plan.path,
                best=plan.best,
                kinds=plan.kinds,
                status=PlanStatus(plan.status),
                stage2_cost=plan.stage2_cost,
                clearance=plan.clearance,
            )
            for plan in contents.plans
            if len(plan.path)
        ]
        changes = ((stamp, contents.world(name)) for name, stamp in contents.stamps.items() if "world_change" in name)
        found = [(source_time(stamp), world) for stamp, world in changes if world is not None]
        self._changes = sorted(found, key=lambda change: change[0])
