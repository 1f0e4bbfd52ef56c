"""Encoding of the ROS 2 messages in flight logs, of the drone and of the workbench: topics and CDR bytes.

Needs no ROS. `aero_planner.onboard.ros_definitions` has the types.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.mission_progress import MissionEvent
from aero_planner.onboard.ros_definitions import (
    CLOUD,
    COSTS,
    GOAL,
    MARKERS,
    MISSION,
    ODOMETRY,
    PATH,
    PLAN,
    SAFETY,
    TRANSFORMS,
)
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.plan import Goal, VehicleState
from aero_planner.quaternions import conjugate, rotate

_SECONDS_MAX = 2**31 - 1
WORLD, BODY = "world", "body"
"""Names of the coordinate frames: the fixed frame, and the body frame, in which points are logged."""

_FLOAT32, _UINT32 = 7, 6
_ADD, _LINE_STRIP, _TEXT = 0, 4, 9
_GUIDE_COLOR = (0.95, 0.75, 0.2, 0.8)
_ROLLOUT_COLOR = (0.3, 0.6, 1.0, 0.8)
_BEST_COLOR = (0.2, 0.9, 0.4, 1.0)
"""Colours as red, green, blue, opacity."""
WIDTH, BEST_WIDTH = 0.02, 0.05
"""Widths of lines [m]."""
_NO_TEXTURE = struct.pack("<IIB3xiIIB3xIB3xII", 0, 1, 0, 0, 0, 1, 0, 1, 0, 0, 0)
"""No colors, and texture_resource, texture and uv_coordinates that are empty, from a multiple of 4 bytes on."""
_NO_MESH = struct.pack("<IB3xIB3xIB", 1, 0, 1, 0, 0, 0)
"""An empty mesh_resource and mesh_file, and mesh_use_embedded_materials, in the same way."""


def wall_time() -> float:
    """Return the wall time for stamps [s]; beside the years that ROS can express, the nearest day of them.

    The seconds of its stamps have 32 bits. A day is left, so that a log that begins now has different stamps.
    """
    return min(max(time.time(), 0.0), _SECONDS_MAX - 86_400.0)


class CdrWriter:
    """Writes little-endian CDR: each number is aligned to its size, counted from the end of the 4-byte header."""

    def __init__(self) -> None:
        self._data = bytearray(b"\x00\x01\x00\x00")

    def pack(self, code: str, *values: float) -> None:
        """Append numbers of one type, such as "I" or "d"."""
        self._align(struct.calcsize(code))
        self._data += struct.pack(f"<{len(values)}{code}", *values)

    def text(self, value: str) -> None:
        """Append a string."""
        data = value.encode() + b"\0"
        self.pack("I", len(data))
        self._data += data

    def array(self, values: ArrayLike, kind: str, *, counted: bool) -> None:
        """Append numbers of a NumPy type, preceded by their count if `counted`."""
        content = np.ascontiguousarray(values, dtype=kind)
        if counted:
            self.pack("I", content.size)
        if content.size:
            self._align(content.itemsize)
            self._data += content.tobytes()

    def header(self, stamp: int, frame_id: str) -> None:
        """Append a std_msgs/Header with the stamp [ns]."""
        seconds, rest = divmod(stamp, 10**9)
        self.pack("i", min(max(seconds, -_SECONDS_MAX), _SECONDS_MAX))
        self.pack("I", rest)
        self.text(frame_id)

    def pose(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Append position and orientation. The quaternion is passed as w x y z and written as x y z w."""
        w, x, y, z = np.asarray(quaternion, dtype=np.float64)
        self.pack("d", *np.asarray(position, dtype=np.float64), x, y, z, w)

    def marker(
        self,
        identity: tuple[str, int],
        stamp: int,
        *,
        scale: float,
        color: ArrayLike,
        line: ArrayLike = (),
        text: str = "",
        at: ArrayLike = (0.0, 0.0, 0.0),
    ) -> None:
        """Append a visualization_msgs/Marker in the world frame that stays until it is replaced.

        Args:
            identity: Namespace and id.
            stamp: [ns].
            scale: Width of the line, or height of the letters [m].
            color: Red, green, blue and opacity.
            line: Points of a line strip [m], shape [n, 3]; empty for a text.
            text: A text that faces the viewer.
            at: Where it stands [m], shape [3].
        """
        points = np.asarray(line, dtype=np.float64)
        self.header(stamp, WORLD)
        self.text(identity[0])
        self.pack("i", identity[1], _LINE_STRIP if len(points) else _TEXT, _ADD)
        self.pose(at, (1.0, 0.0, 0.0, 0.0))
        self.pack("d", *((scale, 0.0, 0.0) if len(points) else (0.0, 0.0, scale)))
        self.pack("f", *np.asarray(color, dtype=np.float64))
        self.pack("I", 0, 0)  # lifetime: until replaced
        self.pack("B", 0)  # frame_locked
        self.pack("I", len(points))
        self.array(points, "<f8", counted=False)
        self._data += _NO_TEXTURE
        self.text(text)
        self._align(4)
        self._data += _NO_MESH

    def done(self) -> bytes:
        """Return the message."""
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - 4) % size)


class Encoded(NamedTuple):
    """An encoded message."""

    topic: str
    kind: str
    data: bytes


def pose_messages(state: VehicleState, stamp: int, *, rates: ArrayLike = (0.0, 0.0, 0.0)) -> Iterator[Encoded]:
    """Yield /odometry and /tf, the state of the drone. As usual in ROS, the twist is in the body frame.

    Args:
        state: State of the drone.
        stamp: [ns].
        rates: Body rates [rad/s], shape [3].
    """
    writer = CdrWriter()
    writer.header(stamp, WORLD)
    writer.text(BODY)
    writer.pose(state.position, state.quaternion)
    writer.array(np.zeros(36), "<f8", counted=False)
    writer.pack("d", *rotate(conjugate(state.quaternion), state.velocity), *np.asarray(rates, dtype=np.float64))
    writer.array(np.zeros(36), "<f8", counted=False)
    yield Encoded("/odometry", ODOMETRY, writer.done())
    writer = CdrWriter()
    writer.pack("I", 1)
    writer.header(stamp, WORLD)
    writer.text(BODY)
    writer.pose(state.position, state.quaternion)
    yield Encoded("/tf", TRANSFORMS, writer.done())


def sweep(points: NDArray[np.float32], stamp: int, *, times: NDArray[np.uint32] | None = None) -> Encoded:
    """Return /sweep, the points of one sweep.

    Args:
        points: Body frame [m], shape [n, 3].
        stamp: [ns].
        times: Time of each point after the stamp [ns], shape [n]; None for deskewed points.
    """
    return cloud("/sweep", BODY, points, stamp, more={} if times is None else {"t": times})


def cloud(
    topic: str, frame_id: str, points: NDArray[Any], stamp: int, *, more: Mapping[str, NDArray[Any]] | None = None
) -> Encoded:
    """Return points [m], shape [n, 3], with further fields of float32 or uint32, shape [n], at `stamp` [ns]."""
    fields: dict[str, NDArray[Any]] = {name: points[:, axis] for axis, name in enumerate("xyz")} | dict(more or {})
    kinds = {name: "<u4" if values.dtype.kind == "u" else "<f4" for name, values in fields.items()}
    rows = np.empty(len(points), dtype=list(kinds.items()))
    writer = CdrWriter()
    writer.header(stamp, frame_id)
    writer.pack("I", 1, len(rows), len(fields))
    for index, (name, values) in enumerate(fields.items()):
        rows[name] = values
        writer.text(name)
        writer.pack("I", 4 * index)
        writer.pack("B", _UINT32 if kinds[name] == "<u4" else _FLOAT32)
        writer.pack("I", 1)
    writer.pack("B", 0)
    writer.pack("I", rows.itemsize, rows.nbytes)
    writer.array(np.frombuffer(rows.tobytes(), np.uint8), "|u1", counted=True)
    writer.pack("B", 1)
    return Encoded(topic, CLOUD, writer.done())


def goal_message(goal: Goal, stamp: int) -> Encoded:
    """Return /goal at `stamp` [ns]. Without an attitude, the orientation is the identity."""
    writer = CdrWriter()
    writer.header(stamp, WORLD)
    writer.pose(goal.position, (1.0, 0.0, 0.0, 0.0) if goal.quaternion is None else goal.quaternion)
    return Encoded("/goal", GOAL, writer.done())


def plan_messages(
    plan: Any, stamp: int, *, plan_ms: float, config_version: int = 0, lines: bool = True
) -> Iterator[Encoded]:
    """Yield a plan: /plan (costs), /plan/best (the path flown), /plan/guides and /plan/rollouts.

    A planner with other terms than goal and collision has /plan/costs, too, and one without guides no /plan/guides.

    Args:
        plan: Plan of one drone, or any that has candidate paths, their costs and a choice as that does.
        stamp: [ns].
        plan_ms: Duration of planning [ms].
        config_version: Version in the name of the attachment config_<version>.yaml.
        lines: Also yield guides and rollouts, which are ten times the size of the rest.
    """
    yield Encoded("/plan", PLAN, _summary(plan, stamp, plan_ms, config_version))
    yield best_path(plan, stamp)
    if not {"goal", "collision"}.issuperset(plan.costs):
        yield Encoded("/plan/costs", COSTS, _costs(plan.costs, stamp))
    if lines:
        if (guides := guide_lines(plan, stamp)) is not None:
            yield guides
        rollouts = _lines("rollouts", plan.positions, stamp, color=_ROLLOUT_COLOR, best=int(plan.best))
        yield Encoded("/plan/rollouts", MARKERS, rollouts)


def best_path(plan: Any, stamp: int) -> Encoded:
    """Return /plan/best, the path that is flown, at `stamp` [ns]."""
    best = int(plan.best)
    return Encoded("/plan/best", PATH, _path(plan.positions[best], plan.quaternions[best], stamp))


def guide_lines(plan: Any, stamp: int) -> Encoded | None:
    """Return /plan/guides at `stamp` [ns]; None if the plan has none."""
    if "guides" not in plan.extensions:
        return None
    return Encoded("/plan/guides", MARKERS, _lines("guides", plan.guides, stamp, color=_GUIDE_COLOR))


def safety_change(change: StateChange, stamp: int) -> Encoded:
    """Return /safety, a transition of the safety state, at `stamp` [ns]."""
    writer = CdrWriter()
    writer.header(stamp, WORLD)
    for text in (change.source.name, change.target.name, change.cause.value):
        writer.text(text)
    return Encoded("/safety", SAFETY, writer.done())


def mission_event(event: MissionEvent) -> Encoded:
    """Return /mission, the end of a leg of the mission as a sentence."""
    writer = CdrWriter()
    writer.text(event.text)
    return Encoded("/mission", MISSION, writer.done())


def _summary(plan: Any, stamp: int, plan_ms: float, config_version: int) -> bytes:
    writer = CdrWriter()
    writer.header(stamp, WORLD)
    writer.pack("I", len(plan.kinds))
    for kind in plan.kinds:
        writer.text(kind)
    writer.pack("i", int(plan.best), int(plan.status))  # type: ignore[arg-type]
    none = np.zeros(len(plan.kinds), np.float32)
    terms = (plan.costs.get(name, none) for name in ("goal", "collision"))
    for values in (plan.cost, *terms, plan.clearance.min(axis=1)):
        writer.array(values, "<f4", counted=True)
    writer.array(plan.command[0], "<f4", counted=False)
    writer.pack("f", plan_ms)
    writer.pack("I", config_version)
    return writer.done()


def _costs(costs: Mapping[str, NDArray[Any]], stamp: int) -> bytes:
    writer = CdrWriter()
    writer.header(stamp, WORLD)
    writer.pack("I", len(costs))
    for name in costs:
        writer.text(name)
    writer.array(np.concatenate([*costs.values(), np.zeros(0)]), "<f4", counted=True)
    return writer.done()


def _path(positions: NDArray[Any], quaternions: NDArray[Any], stamp: int) -> bytes:
    """Return a path of n poses in the world frame, from positions [m], shape [n, 3], and quaternions, shape [n, 4]."""
    writer = CdrWriter()
    writer.header(stamp, WORLD)
    writer.pack("I", len(positions))
    for position, quaternion in zip(positions, quaternions, strict=True):
        writer.header(stamp, WORLD)
        writer.pose(position, quaternion)
    return writer.done()


def _lines(name: str, lines: NDArray[Any], stamp: int, *, color: tuple[float, ...], best: int | None = None) -> bytes:
    """Return one line strip per instance from points in the world frame [m], shape [M, n, 3].

    A line keeps its id from plan to plan.
    """
    writer = CdrWriter()
    writer.pack("I", len(lines))
    for index, line in enumerate(lines):
        width = BEST_WIDTH if index == best else WIDTH
        writer.marker((name, index), stamp, scale=width, color=_BEST_COLOR if index == best else color, line=line)
    return writer.done()
