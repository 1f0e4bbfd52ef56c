"""Progress of a drone in a mission: which waypoint it flies to, and how each leg has ended.

`MissionProgress` is immutable, so that a checkpoint of a flight holds it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

from numpy.typing import ArrayLike

from aero_planner.missions import Mission, Position, Waypoint, as_position, between, point
from aero_planner.plain_text import one_line

Obstacle = Callable[[Position, Position], str | None]
"""Says what is in the way from the first position to the second one, such as "it lies inside box 3"; None if nothing is
known."""
EventKind = Literal["passed", "stopped", "given_up"]
STOPPED = 0.5
"""Speed below which a drone has stopped [m/s]."""
_NEARER = 0.5
"""Decrease of the distance that counts as coming nearer [m]."""
_AHEAD_TIME, _AHEAD = 0.6, 1.0
"""The goal moves beyond a waypoint where the drone is nearer than the distance of this time [s] plus this distance [m],
and by as much: later, the drone would brake; earlier, a way past a gate would be as good as the one through it."""
_TEXT_MAX = 1000
_DEVIATION = 0.2
"""Share of the radius by which the straight way to that goal may miss the waypoint before the goal moves again."""


@dataclass(frozen=True)
class MissionEvent:
    """The end of a leg."""

    time: float
    """[s]."""
    waypoint: int
    """Index in the mission."""
    kind: EventKind
    distance: float
    """Smallest distance to the waypoint [m]."""
    text: str
    """One sentence."""

    @classmethod
    def from_dict(cls, content: Any) -> MissionEvent:
        """Return the event of a mapping with the fields; raises KeyError, TypeError or ValueError if it is none."""
        if content["kind"] not in get_args(EventKind):
            raise ValueError(f"an event of a mission has an unknown kind; known: {', '.join(get_args(EventKind))}.")
        numbers = float(content["time"]), int(content["waypoint"]), float(content["distance"])
        if not all(map(math.isfinite, numbers)):
            raise ValueError("an event of a mission has numbers that are not finite.")
        return cls(numbers[0], numbers[1], content["kind"], numbers[2], one_line(content["text"])[:_TEXT_MAX])


@dataclass(frozen=True, slots=True)
class MissionProgress:
    """Where a drone is in its mission. A waypoint that was passed or given up is never flown to again.

    Args:
        mission: the waypoints.
        index: number of waypoints that are behind the drone; the one with this index is flown to.
        since: time at which the present leg began [s].
        events: ends of the legs so far.
        beyond: place behind a waypoint that is passed, to which the drone flies where it is near [m]; None elsewhere.
        nearest: smallest distance to the waypoint on this leg, at the last time at which it came nearer [m].
        nearest_time: that time [s].
        place: position at the last tick [m]; None before the first one.
        stopped_time: time at which the drone has stopped at the waypoint [s]; None before it has.
    """

    mission: Mission
    index: int = 0
    since: float = 0.0
    events: tuple[MissionEvent, ...] = ()
    beyond: Position | None = None
    nearest: float = math.inf
    nearest_time: float = 0.0
    place: Position | None = None
    stopped_time: float | None = None

    @property
    def waypoint(self) -> Waypoint:
        """The waypoint that is flown to, the last one after the end."""
        return self.mission.waypoints[min(self.index, len(self.mission) - 1)]

    @property
    def is_last(self) -> bool:
        """True if no waypoint follows the present one."""
        return self.index >= len(self.mission) - 1

    @property
    def is_over(self) -> bool:
        """True after the end of the last leg; its waypoint remains the goal."""
        return self.index >= len(self.mission)

    @property
    def passed(self) -> int:
        """Number of waypoints that were passed or stopped at."""
        return sum(event.kind != "given_up" for event in self.events)

    def is_moving(self, time: float) -> bool:
        """Return True while the goal moves along a recorded path."""
        return not self.is_over and time - self.since < self.waypoint.duration

    def goal(self, time: float) -> Position:
        """Return where the planner should fly to at a time [s] [m]."""
        return self.beyond or self.waypoint.at(time - self.since)

    def to_dict(self) -> dict[str, Any]:
        """Return what a log keeps of the progress at the beginning of a leg, without the mission."""
        return {"index": self.index, "since": self.since, "events": [vars(event) for event in self.events]}

    @classmethod
    def from_dict(cls, mission: Mission, content: Any) -> MissionProgress:
        """Return the progress that `to_dict` has written, of a mission; raises ValueError if it is none."""
        try:
            index, since = int(content["index"]), float(content["since"])
            events = tuple(MissionEvent.from_dict(event) for event in content["events"])
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError(f"the progress of a mission is damaged: {error}.") from error
        if not math.isfinite(since):
            raise ValueError("the progress of a mission has a time that is not finite.")
        if not 0 <= index <= len(mission) or not all(0 <= event.waypoint < len(mission) for event in events):
            raise ValueError(f"the progress of a mission of {len(mission)} waypoints has others than these.")
        return cls(mission, index, since, events, nearest_time=since)

    def share(self, start: ArrayLike, position: ArrayLike) -> float:
        """Return the share of the way from a start [m] that a drone at a position [m] has covered, 0 to 1."""
        whole = self.mission.length(start)
        left = 0.0 if self.is_over else Mission(self.mission.waypoints[self.index :]).length(position)
        return max(0.0, 1.0 - left / whole) if whole > 0.0 else 1.0

    def advance(
        self, time: float, position: ArrayLike, speed: float, *, obstacle: Obstacle | None = None
    ) -> MissionProgress:
        """Return the progress at the next tick.

        A waypoint is passed where the drone is nearest to it, if that is within its radius: a gate is left behind, not
        only near. The motion between two ticks counts as a straight line, so that a fast drone does not jump past. The
        last waypoint is never given up, since nothing follows it.

        Args:
            time: [s].
            position: [m].
            speed: [m/s].
            obstacle: asked for the reason when a waypoint is given up.
        """
        if self.is_over:
            return self
        place, waypoint = as_position(position), self.waypoint
        goal, before = waypoint.at(time - self.since), self.place or place
        share = _nearest_share(before, place, goal)
        closest, distance = math.dist(between(before, place, share), goal), math.dist(place, goal)
        here = dataclasses.replace(self, place=place)
        if closest < self.nearest - _NEARER or self.is_moving(time):
            here = dataclasses.replace(here, nearest=closest, nearest_time=time)
        if self.is_moving(time):
            return here
        if here.stopped_time is None and waypoint.stop and distance <= waypoint.radius and speed <= STOPPED:
            here = dataclasses.replace(here, stopped_time=time)
        if here.stopped_time is not None:  # a gust during the hold does not begin it again
            return here if time - here.stopped_time < waypoint.hold else _ended(here, "stopped", time, distance)
        if not waypoint.stop and closest <= waypoint.radius and share < 1.0:
            return _ended(here, "passed", time, closest)
        if time - here.nearest_time >= waypoint.timeout and not self.is_last:
            return here.give_up(time, obstacle=obstacle)
        return _aimed(here, speed, distance, comes_nearer=share >= 1.0)

    def jump(self, time: float) -> MissionProgress:
        """Return the progress after the drone was put elsewhere at a time [s]: it has passed nothing on the way."""
        return dataclasses.replace(self, beyond=None, nearest=math.inf, nearest_time=time, place=None)

    def changed(self, mission: Mission, time: float) -> MissionProgress:
        """Return the progress at a time [s] in a mission that differs ahead of the drone only.

        The leg goes on if its waypoint stays; otherwise, another one begins.

        Raises:
            ValueError: a waypoint behind the drone differs, or none is ahead.
        """
        if mission.waypoints[: self.index] != self.mission.waypoints[: self.index]:
            raise ValueError("a waypoint behind the drone cannot be changed; change those ahead.")
        if len(mission) <= self.index:
            raise ValueError("the mission has no waypoint ahead of the drone; give at least one.")
        if not self.is_over and mission.waypoints[self.index] == self.waypoint:
            return dataclasses.replace(self, mission=mission, beyond=None)
        return MissionProgress(mission, self.index, time, self.events, nearest_time=time, place=self.place)

    def paused(self, time: float, duration: float) -> MissionProgress:
        """Return the progress after a time [s] in which the drone did not fly the mission, at its end `time` [s]."""
        stopped = None if self.stopped_time is None else self.stopped_time + duration
        return dataclasses.replace(self.jump(time), since=self.since + duration, stopped_time=stopped)

    def arrive(self, time: float, position: ArrayLike) -> MissionProgress:
        """Return the progress after an arrival by other rules, at a time [s] and a position [m]."""
        distance = math.dist(as_position(position), self.waypoint.position)
        return self if self.is_over else _ended(self, "stopped" if self.waypoint.stop else "passed", time, distance)

    def give_up(self, time: float, *, obstacle: Obstacle | None = None) -> MissionProgress:
        """Return the progress after the present waypoint is given up at a time [s], for the sake of the next one."""
        nearest = min(self.nearest, math.inf if self.place is None else math.dist(self.place, self.waypoint.position))
        reason = f"the drone has not come nearer than {nearest:.1f} m within {time - self.nearest_time:.0f} s"
        if nearest <= self.waypoint.radius:
            reason = f"the drone has not stopped there within {time - self.nearest_time:.0f} s"
        cause = None if obstacle is None or self.place is None else obstacle(self.place, self.waypoint.position)
        return _ended(self, "given_up", time, nearest, reason if cause is None else f"{reason}; {cause}")


def _ended(
    progress: MissionProgress,
    kind: EventKind,
    time: float,
    distance: float,
    reason: str = "",
) -> MissionProgress:
    """Return the progress at the beginning of the next leg."""
    mission, index = progress.mission, progress.index
    subject = f"Waypoint {index + 1} of {len(mission)} at {point(progress.waypoint.position)} was"
    text = {
        "passed": f"{subject} passed after {time:.2f} s, {distance:.2f} m from it.",
        "stopped": f"{subject} reached after {time:.2f} s.",
        "given_up": f"{subject} given up after {time:.2f} s: {reason}.",
    }[kind]
    events = (*progress.events, MissionEvent(time, index, kind, distance, text))
    return MissionProgress(mission, index + 1, time, events, nearest_time=time, place=progress.place)


def _aimed(progress: MissionProgress, speed: float, distance: float, *, comes_nearer: bool) -> MissionProgress:
    """Return the progress with a goal beyond the waypoint where the drone comes near it and flies on."""
    waypoint, place, beyond = progress.waypoint, progress.place, progress.beyond
    assert place is not None
    if beyond is not None:
        if not comes_nearer and distance > progress.nearest + 2.0 * _NEARER:  # it is missed
            return dataclasses.replace(progress, beyond=None)
        nearest = between(place, beyond, _nearest_share(place, beyond, waypoint.position))
        is_on_course = math.dist(nearest, waypoint.position) <= _DEVIATION * waypoint.radius
        if is_on_course or distance <= waypoint.radius:
            return progress
    reach = _AHEAD_TIME * speed + _AHEAD
    if progress.is_last or waypoint.stop or waypoint.path or not comes_nearer or not 0.0 < distance < reach:
        return progress
    return dataclasses.replace(progress, beyond=between(place, waypoint.position, 1.0 + reach / distance))


def _nearest_share(a: Position, b: Position, point: Position) -> float:
    """Return where the straight line from a to b is nearest to a point, 0 to 1; 0 if a is b."""
    along = [end - begin for begin, end in zip(a, b, strict=True)]
    length = sum(value * value for value in along)
    if length == 0.0:
        return 0.0
    share = sum(value * (p - begin) for value, p, begin in zip(along, point, a, strict=True)) / length
    return min(max(share, 0.0), 1.0)
