"""ROS 2 messages of the flight log: CDR bytes, and the definitions that a reader needs, without ROS.

Only what the log holds. Types are ROS 2's own, so that every tool reads them, save two that are defined here.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.onboard.safety import Change
from aero_planner.plan import Plan, VehicleState

__all__ = ["BODY", "DEFINITIONS", "WORLD", "odometry", "path", "plan_summary", "safety_change", "sweep", "transform"]

WORLD, BODY = "world", "body"
"""Names of the frames: the fixed one, and the drone's, in which points are logged."""

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
CLOUD = "sensor_msgs/msg/PointCloud2"
PATH = "nav_msgs/msg/Path"
PLAN = "aero_viz_msgs/msg/Plan"
SAFETY = "aero_planner_msgs/msg/Safety"

_FLOAT32, _UINT32 = 7, 6

PLAN_DEFINITION = """\
# What one tick of the planner decided. Arrays have one entry per instance of the ensemble, M in all.
std_msgs/Header header
string[] kinds            # "anchor", "previous", "brake"
int32 best                # the instance that is flown
int32 status              # 0 safe, 1 no safe candidate: braking, 2 the cloud is stale: braking
float32[] stage2_cost     # S2 = J_goal + J_col + options
float32[] goal_cost       # J_goal
float32[] collision_cost  # J_col
float32[] clearance       # smallest distance to the cloud over the horizon [m]
float32[4] command        # first control flown: thrust [N], body rates [rad/s]
float32 plan_ms           # time that planning took [ms]
uint32 config_version     # attachment config_<version>.yaml
"""

_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count\n",
}
_MESSAGES = {
    ODOMETRY: (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    ),
    TRANSFORMS: "geometry_msgs/TransformStamped[] transforms\n",
    CLOUD: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense\n"
    ),
    PATH: "std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n",
    PLAN: PLAN_DEFINITION,
    SAFETY: (
        "# The node's safety state changed.\n"
        "std_msgs/Header header\nstring source  # state before\nstring target  # state now\nstring cause\n"
    ),
}


def _definition(text: str) -> str:
    """Return `text` followed by the definitions of its parts, as MCAP's "ros2msg" schemas have it."""
    found: list[str] = []
    waiting = [text]
    while waiting:
        for line in waiting.pop(0).splitlines():
            name = line.split("#")[0].split(" ")[0].split("[")[0]
            if name in _PARTS and name not in found:
                found.append(name)
                waiting.append(_PARTS[name])
    return "".join([text, *(f"{'=' * 80}\nMSG: {name}\n{_PARTS[name]}" for name in found)])


DEFINITIONS: dict[str, str] = {kind: _definition(text) for kind, text in _MESSAGES.items()}
"""Definition of each message with those of its parts."""


class _Writer:
    """Little-endian CDR: every number aligned to its own size, counted from behind the four bytes at the start."""

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
        """Append numbers of a NumPy type, their number first when `counted`."""
        content = np.ascontiguousarray(values, dtype=kind)
        if counted:
            self.pack("I", content.size)
        if content.size:
            self._align(content.itemsize)
            self._data += content.tobytes()

    def header(self, stamp: int, frame: str) -> None:
        """Append a std_msgs/Header, stamp in [ns]."""
        self.pack("i", stamp // 10**9)
        self.pack("I", stamp % 10**9)
        self.text(frame)

    def pose(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Append position and orientation; the quaternion is given as w x y z and kept as x y z w."""
        w, x, y, z = np.asarray(quaternion, dtype=np.float64)
        self.pack("d", *np.asarray(position, dtype=np.float64), x, y, z, w)

    def done(self) -> bytes:
        """Return the message."""
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - 4) % size)


def odometry(state: VehicleState, velocity_body: ArrayLike, stamp: int) -> bytes:
    """Return a nav_msgs/Odometry; the velocity [m/s], shape [3], is in the body frame, as ROS has it."""
    writer = _Writer()
    writer.header(stamp, WORLD)
    writer.text(BODY)
    writer.pose(state.position, state.quaternion)
    writer.array(np.zeros(36), "<f8", counted=False)
    writer.pack("d", *np.asarray(velocity_body, dtype=np.float64), 0.0, 0.0, 0.0)
    writer.array(np.zeros(36), "<f8", counted=False)
    return writer.done()


def transform(state: VehicleState, stamp: int) -> bytes:
    """Return a tf2_msgs/TFMessage from the world to the body."""
    writer = _Writer()
    writer.pack("I", 1)
    writer.header(stamp, WORLD)
    writer.text(BODY)
    writer.pose(state.position, state.quaternion)
    return writer.done()


def sweep(points: NDArray[np.float32], times: NDArray[np.uint32], stamp: int) -> bytes:
    """Return a sensor_msgs/PointCloud2.

    Args:
        points: [m], shape [n, 3], body frame.
        times: after the stamp [ns], shape [n].
        stamp: [ns].
    """
    rows = np.empty(len(points), dtype=[("xyz", "<f4", 3), ("t", "<u4")])
    rows["xyz"], rows["t"] = points, times
    writer = _Writer()
    writer.header(stamp, BODY)
    writer.pack("I", 1, len(rows), 4)
    for offset, (name, kind) in enumerate((("x", _FLOAT32), ("y", _FLOAT32), ("z", _FLOAT32), ("t", _UINT32))):
        writer.text(name)
        writer.pack("I", 4 * offset)
        writer.pack("B", kind)
        writer.pack("I", 1)
    writer.pack("B", 0)
    writer.pack("I", rows.itemsize, rows.nbytes)
    writer.array(np.frombuffer(rows.tobytes(), np.uint8), "|u1", counted=True)
    writer.pack("B", 1)
    return writer.done()


def path(positions: ArrayLike, quaternions: ArrayLike, stamp: int) -> bytes:
    """Return a nav_msgs/Path of n poses: [m], shape [n, 3]; w x y z, shape [n, 4]; world frame."""
    poses = list(zip(np.asarray(positions), np.asarray(quaternions), strict=True))
    writer = _Writer()
    writer.header(stamp, WORLD)
    writer.pack("I", len(poses))
    for position, quaternion in poses:
        writer.header(stamp, WORLD)
        writer.pose(position, quaternion)
    return writer.done()


def plan_summary(plan: Plan, plan_ms: float, stamp: int) -> bytes:
    """Return an aero_viz_msgs/Plan."""
    writer = _Writer()
    writer.header(stamp, WORLD)
    _texts(writer, plan.kinds)
    writer.pack("i", int(plan.best), int(plan.status))  # type: ignore[arg-type]
    for values in (plan.stage2_cost, plan.goal_cost, plan.collision_cost, plan.clearance.min(axis=1)):
        writer.array(values, "<f4", counted=True)
    writer.array(plan.command[0], "<f4", counted=False)
    writer.pack("f", plan_ms)
    writer.pack("I", 0)
    return writer.done()


def safety_change(change: Change, stamp: int) -> bytes:
    """Return an aero_planner_msgs/Safety."""
    writer = _Writer()
    writer.header(stamp, WORLD)
    for text in (change.source.name, change.target.name, change.cause.value):
        writer.text(text)
    return writer.done()


def _texts(writer: _Writer, values: Iterable[str]) -> None:
    texts = list(values)
    writer.pack("I", len(texts))
    for text in texts:
        writer.text(text)
