"""Visibility of a place: when it came into sight and into the cloud, and what kept it out: range, view, or occlusion.

What hides a place is found by rays in the world or, where no world is known, by hidden points of the planner's cloud.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.quaternions import conjugate, quaternion_from_angles, rotate
from aero_viz.explain.hidden_points import NEAR, hides
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors import LidarModel
from aero_viz.sensors.raycast import cast
from aero_viz.session.frame import Frame

Array = NDArray[np.float64]

_FRAMES, _FRAMES_WITHOUT_WORLD = 100, 12
"""Last ticks whose lines of sight are examined, with rays and with hidden points."""
_IN_SIGHT, _UNCERTAIN = "in sight", "not known"
_SHOWN = "what the cloud shows before it"


@dataclass(frozen=True)
class Seen:
    """Presence of a place on an obstacle in the cloud."""

    since_s: float | None
    """Time since which it was in the cloud, without a gap up to the end [s]; None if it was not at the end."""
    from_start: bool
    """True if that is the first tick that was examined: it may have been there before."""
    forgotten_s: float | None
    """Last time at which it was in the cloud, if it was and was not at the end [s]."""
    reason: str | None
    """Reason for its earlier absence from the cloud: "beyond range", "outside the field of view", "occluded",
    "forgotten", "no ray hit it" or "not known"; None if it always was there."""
    detail: str
    """The same as a part of a sentence, such as "occluded by box 3 in 41 of 50 ticks"."""
    in_sight_s: float | None = None
    """Last time at which it was in sight of the sensor: within range and view, and certainly not hidden [s]."""
    last_sight: str = ""
    """What kept it from sight at the end, such as "occluded by box 3"; empty if it was in sight, or is not known."""


def find_seen(frames: Sequence[Frame], place: Array) -> Seen:
    """Return when a place on a surface entered the cloud of the planner.

    Args:
        frames: frames up to the end, in the order of time.
        place: where the drone hit, or would have [m], shape [3]. Of an obstacle that moves, where that was in each
            frame, shape [frames, 3]: then the newest sweep counts alone.
    """
    moves = np.ndim(place) == 2
    places = np.broadcast_to(place, (len(frames), 3))
    holds: dict[tuple[int, float, float], bool] = {}
    present = []
    for frame, (x, y, z) in zip(frames, places, strict=True):
        keys = [(id(sweep), x, y) for sweep in frame.observation.sweeps]  # the frames keep the sweeps alive
        for sweep, key in list(zip(frame.observation.sweeps, keys, strict=True))[-1 if moves else 0 :]:
            if key not in holds:
                holds[key] = bool((np.linalg.norm(sweep - (x, y, z), axis=1) < NEAR).any())
        present.append(any(holds.get(key, False) for key in keys))
    absent = [i for i, is_there in enumerate(present) if not is_there]
    if not absent:
        return Seen(frames[0].time, True, None, None, "", *_last_sight(frames, places))
    since = frames[absent[-1] + 1].time if absent[-1] + 1 < len(frames) else None
    earlier = [frame.time for frame, is_there in zip(frames, present, strict=True) if is_there]
    forgotten = earlier[-1] if since is None and earlier else None
    absent = absent[-(_FRAMES if frames[-1].world is not None else _FRAMES_WITHOUT_WORLD) :]
    reason, detail = _reason([frames[i] for i in absent], places[absent], len(absent))
    if forgotten is not None and moves:
        detail = f"last in a sweep at {forgotten:.2f} s; since then {detail}"
    elif forgotten is not None:
        reason, detail = "forgotten", f"last in the cloud at {forgotten:.2f} s; since then {detail}"
    return Seen(since, False, forgotten, reason, detail, *_last_sight(frames, places))


def sight_of(frame: Frame, place: Array) -> str:
    """Return what keeps a place [m], [3], from the sight of the sensor, such as "occluded by box 3"; empty if nothing
    does, or if it is not known."""
    return _look([frame], place[None]).words(0)


def _last_sight(frames: Sequence[Frame], places: Array) -> tuple[float | None, str]:
    count = _FRAMES if frames[-1].world is not None else _FRAMES_WITHOUT_WORLD
    frames, places = frames[-count:], places[-count:]
    look = _look(frames, places)
    times = [frame.time for frame, reason in zip(frames, look.reasons, strict=True) if reason == _IN_SIGHT]
    return times[-1] if times else None, look.words(len(frames) - 1)


class _Look(NamedTuple):
    """Lines of sight from the sensor to a place, one per frame."""

    model: LidarModel
    reach: float
    """Range of the sensor and of the planner [m]."""
    distance: Array
    elevation: Array
    azimuth: Array
    """Of the place, in the frame of the sensor [m], [deg], [deg]."""
    reasons: list[str]
    """"in sight", "beyond range", "outside the field of view", "occluded" or "not known"."""
    occluders: list[str]
    """Name of what hides it, where something does."""

    def words(self, i: int) -> str:
        """Return why the place is not in sight in a frame; empty where it is, or where that is not known."""
        reason = self.reasons[i]
        if reason in (_IN_SIGHT, _UNCERTAIN):
            return ""
        return f"occluded by {self.occluders[i]}" if reason == "occluded" else reason


def _look(frames: Sequence[Frame], places: Array) -> _Look:
    """Return the lines of sight to a place that was at `places` [m], shape [frames, 3]."""
    model = FlightSettings.from_dict(frames[0].source.settings).lidar
    states = [frame.observation.actual_state for frame in frames]
    q = np.stack([np.asarray(state.quaternion, dtype=np.float64) for state in states])
    p = np.stack([np.asarray(state.position, dtype=np.float64) for state in states])
    eyes = p + rotate(q, np.asarray(model.mount_position))
    offset = places - eyes
    distance = np.linalg.norm(offset, axis=1)
    body = rotate(conjugate(quaternion_from_angles(*model.mount_angles)), rotate(conjugate(q), offset))
    elevation = np.degrees(np.arcsin(np.clip(body[:, 2] / np.maximum(distance, 1e-9), -1.0, 1.0)))
    azimuth = np.degrees(np.arctan2(body[:, 1], body[:, 0]))
    in_view = model.sees(rotate(conjugate(q), offset))
    configs = [frame.config for frame in frames if isinstance(frame.config, PlannerConfig)]
    range_max = max(sensor.range_max for sensor in model.sensors)
    reach = min(range_max, max((config.farthest_range for config in configs), default=np.inf))
    occluders = _occluders(frames, eyes, offset, distance)
    reasons = []
    for i, occluder in enumerate(occluders):
        if distance[i] > reach:
            reasons.append("beyond range")
        elif not in_view[i]:
            reasons.append("outside the field of view")
        else:
            reasons.append(_UNCERTAIN if occluder is None else "occluded" if occluder else _IN_SIGHT)
    return _Look(model, reach, distance, elevation, azimuth, reasons, [name or "" for name in occluders])


def _reason(frames: Sequence[Frame], places: Array, total: int) -> tuple[str, str]:
    """Return the most frequent reason for which the sensor did not see a place, and a part of a sentence.

    `places` are where it was in each frame [m], shape [frames, 3].
    """
    look = _look(frames, places)
    model, names = look.model, Counter(filter(None, look.occluders))
    reason, count = Counter(look.reasons).most_common(1)[0]
    counted = [i for i, name in enumerate(look.reasons) if name == reason]
    beside = ""
    if model.azimuth_max - model.azimuth_min < 360.0:
        beside = (
            f", and at azimuths of {look.azimuth[counted].min():.0f} to {look.azimuth[counted].max():.0f} deg, of "
            f"which it sees {model.azimuth_min:g} to {model.azimuth_max:g} deg"
        )
    detail = {
        "beyond range": f"{look.distance[counted].min():.1f} m away or more, beyond the range of {look.reach:g} m",
        "outside the field of view": (
            f"at elevations of {look.elevation[counted].min():.0f} to {look.elevation[counted].max():.0f} deg in the "
            f"frame of the sensor, which sees {model.elevation_min:g} to {model.elevation_max:g} deg{beside}"
        ),
        "occluded": f"occluded by {names.most_common(1)[0][0] if names else 'something'}",
        _IN_SIGHT: "in view, but no ray hit it",
        _UNCERTAIN: "in view, and the cloud does not tell whether something hid it",
    }[reason]
    return "no ray hit it" if reason == _IN_SIGHT else reason, f"{detail}, in {count} of the last {total} ticks"


def _occluders(frames: Sequence[Frame], eyes: Array, offset: Array, distance: Array) -> list[str | None]:
    """Return the name of what hides a place from each eye; empty if nothing does, None if that is not known.

    `offset` leads from the eye to the place, `distance` is its length [m].
    """
    known = [frame.world for frame in frames if frame.world is not None]
    if len(known) < len(frames):
        return [
            _SHOWN if hides(frame.observation.points, eye, place) else "" if _is_measured(frame, place) else None
            for frame, eye, place in zip(frames, eyes, eyes + offset, strict=True)
        ]
    # An eye at the place itself has no direction to it; nothing occludes the place from there.
    directions = offset / np.maximum(distance, 1e-9)[:, None]
    packed = DeviceWorlds(known)
    with wp.ScopedDevice("cpu"):
        origins, rays = wp.array(eyes, dtype=wp.vec3), wp.array(directions[:, None], dtype=wp.vec3)
        ranges = np.asarray(cast(packed, origins, rays).numpy())[:, 0]
    is_occluded = ranges < distance - NEAR
    hits = eyes + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * directions
    found = zip(known, hits, is_occluded, strict=True)
    return [world.nearest(hit)[1] if occludes else "" for world, hit, occludes in found]


def _is_measured(frame: Frame, place: Array) -> bool:
    """Return True if the newest sweep has a point at a place [m], shape [3]."""
    sweeps = list(frame.observation.sweeps)
    return bool(sweeps) and bool((np.linalg.norm(sweeps[-1] - place, axis=1) < NEAR).any())
