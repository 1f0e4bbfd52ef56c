"""Where to fly: a goal or a mission, as given at the start or received over the link."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.mission_progress import MissionEvent, MissionProgress
from aero_planner.missions import Mission, Position, as_position
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.failsafe_conditions import is_inside_fence
from aero_planner.onboard.interfaces import VehicleLink
from aero_planner.onboard.mission_offer import MissionOffer
from aero_planner.onboard.settings import LimitSettings

_log = logging.getLogger(__name__)

Target: TypeAlias = NDArray[np.float64] | Mission
"""A goal [m], shape [3], world frame, or a mission."""


class GoalTracker:
    """Keeps the newest goal or mission that lies inside the geofence, whose heights count from the ground.

    It is checked again when the height of the ground becomes known. If it then lies outside, there is no goal. Later
    the height may be that of a roof below the drone, which tells nothing about the goal.

    Args:
        limits: Settings of the geofence.
        goal: The first goal [m], shape [3], world frame, or mission; None if there is none yet. Outside the heights
            above the local origin it waits until the height of the ground is known.

    Raises:
        ValueError: The goal is not three finite numbers, or lies outside the geofence at any height of the ground.

    Attributes:
        goal: The present goal [m], shape [3], world frame, which a mission moves; None if there is none.
        progress: Progress in the mission; None if there is a goal, or neither.
        count: Number of goals and missions accepted over the link.
    """

    def __init__(self, limits: LimitSettings, goal: ArrayLike | Mission | None) -> None:
        self.goal: NDArray[np.float64] | None = None
        self.progress: MissionProgress | None = None
        self.count = 0
        self._limits = limits
        self._time = 0.0
        self._alone: MissionProgress | None = None
        """Progress to a goal that is no mission."""
        self._is_warned = False
        self._received: NDArray[np.float64] | None = None
        self._is_accepted = False
        self._is_ground_known = False
        self._ground = 0.0
        self._first: Target | None = None
        if goal is not None:
            self._first = goal if isinstance(goal, Mission) else np.array(goal, dtype=np.float64)
            self._check_first(self._first)

    @property
    def speed_limit(self) -> float | None:
        """Speed limit of the present leg [m/s]; None if it has none of its own."""
        return None if self.progress is None or self.progress.is_over else self.progress.waypoint.speed

    def distance(self, position: ArrayLike) -> float:
        """Return the distance from a position [m] to the goal, at which the flight ends [m].

        It is infinite without a goal, before the last leg of a mission, and while its goal moves.
        """
        progress = self.progress
        if self.goal is None or (progress and (not progress.is_last or progress.is_moving(self._time))):
            return math.inf
        return float(np.linalg.norm(self.goal - np.asarray(position, dtype=np.float64)))

    def follow(
        self,
        link: VehicleLink,
        time: float,
        motion: MotionState | None,
        *,
        ground: float | None,
        flying: bool,
        refusal: str,
    ) -> MissionEvent | None:
        """Take what has arrived on the link, follow the mission, and tell the link about it.

        Args:
            link: Gives goals and missions.
            time: Host time [s].
            motion: Of the drone; None if it is unknown.
            ground, flying, refusal: See `update` and `advance`.

        Returns:
            The end of a leg, if there is one.
        """
        place = None if motion is None or not motion.is_finite else motion.position
        self.update(link.goal, link.offer, ground=ground, refusal=refusal, place=place if flying else None)
        event = None
        if motion is not None and place is not None:
            event = self.advance(time, place, motion.speed, flying=flying)
        link.report_mission(self.progress)
        return event

    def update(
        self,
        goal: NDArray[np.float64] | None,
        offer: MissionOffer | None = None,
        *,
        ground: float | None = None,
        refusal: str = "",
        place: ArrayLike | None = None,
    ) -> None:
        """Accept what is newest on the link, and check what is present; what lies outside the fence is refused.

        If it is refused, the present goal or mission is kept. A refused goal that is sent again is checked again, since
        the ground may be known better by then. Sending the accepted goal again changes nothing.

        Args:
            goal: The last goal received [m], shape [3], world frame: a new array for each message.
            offer: The last mission received, which is answered once.
            ground: Height of the ground, world frame [m]; None while it is unknown, and the heights of the fence
                count from the local origin.
            refusal: Why no mission is taken now; empty if one is.
            place: Position of a drone that flies [m], where it stops if its mission is cleared; None on the ground.
        """
        self._ground = ground or 0.0
        if goal is not None and goal is not self._received:
            self._receive(goal, ground)
        if offer is not None and offer.answer is None:
            offer.answer = refusal or self._take(offer.mission, ground, place)
            if offer.answer:
                _log.error("the mission is refused: %s", offer.answer)
        if ground is not None and not self._is_ground_known:
            self._check_again(ground)
        self._is_ground_known = ground is not None

    def advance(self, time: float, position: ArrayLike, speed: float, *, flying: bool) -> MissionEvent | None:
        """Follow the mission to a time [s]; return the end of a leg, if there is one.

        Args:
            time: Host time [s].
            position: [m], shape [3], world frame.
            speed: [m/s].
            flying: False while the drone does not fly to the goal: no time of the mission passes.
        """
        passed, self._time = time - self._time, time
        before = self.progress
        if before is None:
            if self._alone is not None and self.goal is not None:
                alone = self._alone
                self._alone = alone.advance(time, position, speed) if flying else alone.paused(time, passed)
                self._warn(self._alone, time, position)
            return None
        is_near = math.dist(as_position(position), before.waypoint.position) <= self._limits.arrival_radius
        if not flying:
            progress = before.paused(time, passed)
        elif is_near and before.is_last and not before.is_moving(time):
            progress = before.arrive(time, position)  # the state machine ends the flight here
        else:
            progress = before.advance(time, position, speed)
        if self.goal is not None:
            self._follow(progress)
            self._warn(progress, time, position)
        if len(progress.events) == len(before.events):
            return None
        event = progress.events[-1]
        _log.log(logging.WARNING if event.kind == "given_up" else logging.INFO, "%s", event.text)
        return event

    def jump(self) -> None:
        """Forget where the drone was: the estimator was reset."""
        if self.progress is not None:
            self.progress = self.progress.jump(self._time)

    def _warn(self, progress: MissionProgress, time: float, position: ArrayLike) -> None:
        """Say it once if the drone comes no nearer to the last goal for a while."""
        since = time - progress.nearest_time
        if self._is_warned or since < progress.waypoint.timeout or not math.isfinite(progress.nearest):
            return
        if self._limits.arrival_radius < self.distance(position) < math.inf:
            self._is_warned = True
            _log.warning(
                "the drone has not come nearer than %.1f m to the goal within %.0f s: the goal may lie in an obstacle; "
                "it is kept, send another one to fly elsewhere", progress.nearest, since,
            )  # fmt: skip

    def _follow(self, progress: MissionProgress) -> None:
        """Fly to where the progress says; a goal behind a waypoint may lie outside the fence, the waypoint does not."""
        self.progress = progress
        goal = progress.goal(self._time)
        if progress.beyond is not None and not is_inside_fence(goal, self._limits, ground=self._ground):
            goal = progress.waypoint.at(self._time - progress.since)
        self.goal = np.array(goal, dtype=np.float64)

    def _check_first(self, goal: Target) -> None:
        if not isinstance(goal, Mission) and (goal.shape != (3,) or not np.isfinite(goal).all()):
            raise ValueError(f"the goal is {goal.tolist()}; it must be three finite numbers [m].")
        for name, place in named_places(goal):
            if not is_inside_fence([*place[:2], self._limits.fence_height_min], self._limits):
                raise ValueError(
                    f"{_called(name)} {list(place)} lies outside the geofence; correct it or limits.fence_*."
                )
        if outside := self._outside(goal, None):
            _log.warning("%s waits until the height of the ground is known: it %s", *outside)
        else:
            self._accept(goal)

    def _receive(self, goal: NDArray[np.float64], ground: float | None) -> None:
        is_repeated = self._received is not None and np.array_equal(goal, self._received, equal_nan=True)
        self._received = goal
        if is_repeated and self._is_accepted:
            return
        outside = self._outside(goal, ground)
        self._is_accepted = outside is None
        if outside is None:
            self._accept(goal)
            self.count, self._first = self.count + 1, None
        elif not is_repeated:
            _log_refusal(*outside)

    def _take(self, mission: Mission | None, ground: float | None, place: ArrayLike | None) -> str:
        """Take a mission, or clear the present one; return why it is refused, or ""."""
        target = mission if mission is not None or place is None else np.array(place, dtype=np.float64)
        if target is not None and (outside := self._outside(target, ground)):
            return "{} {}".format(*outside)
        self._first, self._is_accepted = None, False
        if target is None:
            self.goal = self.progress = None
        else:
            self._accept(target)
            self.count += 1
        return ""

    def _check_again(self, ground: float) -> None:
        """Check what is present, or the first goal if there is none, with the height of the ground [m]."""
        present = self.goal if self.progress is None else self.progress.mission
        target = self._first if self.goal is None else present
        if target is None:
            return
        outside = self._outside(target, ground)
        if outside is not None:
            _log_refusal(*outside)
            self.goal, self.progress, self._is_accepted = None, None, False
        elif self.goal is None:
            self._accept(target)

    def _accept(self, goal: Target) -> None:
        self._is_warned = False
        if isinstance(goal, Mission):
            self._follow(MissionProgress(goal, since=self._time, nearest_time=self._time))
            _log.info("the mission has %d waypoints and ends at %s", len(goal), np.round(goal.goal, 2).tolist())
        else:
            self.goal, self.progress = np.array(goal, dtype=np.float64), None
            self._alone = MissionProgress(Mission.to_goal(goal), since=self._time, nearest_time=self._time)
            _log.info("the goal is %s", np.round(self.goal, 2).tolist())

    def _outside(self, goal: Target, ground: float | None) -> tuple[str, str] | None:
        """Return which place lies outside the geofence, and how; None if none does."""
        low, high = self._limits.fence_height_min, self._limits.fence_height_max
        for name, place in named_places(goal):
            if is_inside_fence(place, self._limits, ground=ground or 0.0):
                continue
            where, height = "lies outside the geofence", place[2] - (ground or 0.0)
            if not low <= height <= high:
                below = "the local origin" if ground is None else f"the ground, which is at a height of {ground:.2f} m"
                where += f", at {height:.2f} instead of {low:g} to {high:g} m above {below}"
            return f"{_called(name)} {np.round(place, 2).tolist()}", where
        return None


def named_places(goal: Target) -> Iterator[tuple[str, Position]]:
    """Yield the name and the position of each place to fly to [m]."""
    if not isinstance(goal, Mission):
        yield "goal", as_position(goal)
        return
    for i, waypoint in enumerate(goal.waypoints):
        for place in [*(row[1:] for row in waypoint.path), waypoint.position]:
            yield f"waypoint {i + 1}", place


def _called(name: str) -> str:
    return "the goal" if name == "goal" else name


def _log_refusal(name: str, where: str) -> None:
    advice = "send another goal, or correct --goal or limits.fence_*"
    if "waypoint" in name:
        advice = "send another mission, or correct mission.file or limits.fence_*"
    _log.error("%s is refused: it %s; %s", name, where, advice)
