"""Visibility of a place: when it entered the cloud, and what kept it out before: range, view, occlusion or memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.quaternions import conjugate, quaternion_from_angles, rotate
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.raycast import cast
from aero_viz.session.frame import Frame

Array = NDArray[np.float64]

_NEAR = 0.4
"""Distance up to which a point of the cloud belongs to a place on a surface [m]."""


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
    "forgotten" or "no ray hit it"; None if it always was there."""
    detail: str
    """The same as a part of a sentence, such as "occluded by box 3 in 41 of 50 ticks"."""


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
                holds[key] = bool((np.linalg.norm(sweep - (x, y, z), axis=1) < _NEAR).any())
        present.append(any(holds.get(key, False) for key in keys))
    absent = [i for i, is_there in enumerate(present) if not is_there]
    if not absent:
        return Seen(frames[0].time, True, None, None, "")
    since = frames[absent[-1] + 1].time if absent[-1] + 1 < len(frames) else None
    earlier = [frame.time for frame, is_there in zip(frames, present, strict=True) if is_there]
    forgotten = earlier[-1] if since is None and earlier else None
    absent = absent[-100:]
    reason, detail = _reason([frames[i] for i in absent], places[absent], len(absent))
    if forgotten is not None and moves:
        detail = f"last in a sweep at {forgotten:.2f} s; since then {detail}"
    elif forgotten is not None:
        reason, detail = "forgotten", f"last in the cloud at {forgotten:.2f} s; since then {detail}"
    return Seen(since, False, forgotten, reason, detail)


def _reason(frames: Sequence[Frame], places: Array, total: int) -> tuple[str, str]:
    """Return the most frequent reason for which the sensor did not see a place, and a part of a sentence.

    `places` are where it was in each frame [m], shape [frames, 3].
    """
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
    worlds = [frame.world for frame in frames]
    occluders = _occluders(worlds, eyes, offset, distance)
    reasons, names = [], Counter[str]()
    for i in range(len(frames)):
        if distance[i] > reach:
            reasons.append("beyond range")
        elif not in_view[i]:
            reasons.append("outside the field of view")
        elif occluders[i]:
            reasons.append("occluded")
            names[occluders[i]] += 1
        else:
            reasons.append("no ray hit it")
    reason, count = Counter(reasons).most_common(1)[0]
    counted = [i for i, name in enumerate(reasons) if name == reason]
    beside = ""
    if model.azimuth_max - model.azimuth_min < 360.0:
        beside = (
            f", and at azimuths of {azimuth[counted].min():.0f} to {azimuth[counted].max():.0f} deg, of which it sees "
            f"{model.azimuth_min:g} to {model.azimuth_max:g} deg"
        )
    detail = {
        "beyond range": f"{distance[counted].min():.1f} m away or more, beyond the range of {reach:g} m",
        "outside the field of view": (
            f"at elevations of {elevation[counted].min():.0f} to {elevation[counted].max():.0f} deg in the frame of "
            f"the sensor, which sees {model.elevation_min:g} to {model.elevation_max:g} deg{beside}"
        ),
        "occluded": f"occluded by {names.most_common(1)[0][0] if names else 'something'}",
        "no ray hit it": "in view, but no ray hit it",
    }[reason]
    return reason, f"{detail}, in {count} of the last {total} ticks"


def _occluders(worlds: list[World | None], eyes: Array, offset: Array, distance: Array) -> list[str]:
    """Return the name of the obstacle that occludes a place from each eye, each in its world; empty if none does.

    `offset` leads from the eye to the place, `distance` is its length [m].
    """
    known = [world for world in worlds if world is not None]
    if len(known) < len(worlds):
        return [""] * len(eyes)
    # An eye at the place itself has no direction to it; nothing occludes the place from there.
    directions = offset / np.maximum(distance, 1e-9)[:, None]
    packed = DeviceWorlds(known)
    with wp.ScopedDevice("cpu"):
        origins, rays = wp.array(eyes, dtype=wp.vec3), wp.array(directions[:, None], dtype=wp.vec3)
        ranges = np.asarray(cast(packed, origins, rays).numpy())[:, 0]
    is_occluded = ranges < distance - _NEAR
    hits = eyes + np.where(np.isfinite(ranges), ranges, 0.0)[:, None] * directions
    found = zip(known, hits, is_occluded, strict=True)
    return [world.nearest(hit)[1] if occludes else "" for world, hit, occludes in found]
