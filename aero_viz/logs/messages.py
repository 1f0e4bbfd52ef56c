"""A tick as ROS 2 messages (CDR), with the definitions that a reader needs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from aero_planner import VehicleState
from aero_planner.onboard.messages import PLAN, PLAN_DEFINITION
from aero_viz.frame import Frame
from aero_viz.recordings.rotations import matrices

__all__ = [
    "BODY",
    "PLAN",
    "PLAN_DEFINITION",
    "WORLD",
    "Encoded",
    "body_rates",
    "definition",
    "encode_plan",
    "encode_pose",
    "encode_sweep",
    "true_state",
]

WORLD, BODY = "world", "body"
"""Names of the frames: the fixed one, and the drone's, which is the LiDAR's too."""

_ODOMETRY = "nav_msgs/msg/Odometry"
_TF = "tf2_msgs/msg/TFMessage"
_CLOUD = "sensor_msgs/msg/PointCloud2"
_PATH = "nav_msgs/msg/Path"
_MARKERS = "visualization_msgs/msg/MarkerArray"

_LINE_STRIP = 4
_FLOAT32 = 7
_GUIDE_COLOR = (0.95, 0.75, 0.2, 0.8)
_ROLLOUT_COLOR = (0.3, 0.6, 1.0, 0.8)
_BEST_COLOR = (0.2, 0.9, 0.4, 1.0)


class Encoded(NamedTuple):
    """One message, ready to be written."""

    topic: str
    kind: str
    data: bytes


@cache
def _store():
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(PLAN_DEFINITION, PLAN))
    return store


@cache
def definition(kind: str) -> str:
    """Return the text of a message definition with those of its parts, the form of MCAP's "ros2msg" schemas."""
    return _store().generate_msgdef(kind, ros_version=2)[0]


def encode_pose(state: VehicleState, stamp: int, *, rates: NDArray[np.float64]) -> Iterator[Encoded]:
    """Yield /odometry and /tf: where the drone is at `stamp` [ns]; the twist is in the body frame, as ROS has it.

    Args:
        state: true one where it is known.
        stamp: [ns].
        rates: body rates [rad/s], shape [3].
    """
    position, q = np.asarray(state.position, float), np.asarray(state.quaternion, float)
    twist = np.asarray(state.velocity, float) @ matrices(q)
    rotation = _make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", q.tolist(), strict=True)))
    header, zero = _header(stamp, WORLD), np.zeros(36)
    pose = _make("geometry_msgs/msg/Pose", position=_vector(position, "Point"), orientation=rotation)
    velocity = _make("geometry_msgs/msg/Twist", linear=_vector(twist), angular=_vector(rates))
    yield _encode(
        "/odometry",
        _ODOMETRY,
        header=header,
        child_frame_id=BODY,
        pose=_make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=zero),
        twist=_make("geometry_msgs/msg/TwistWithCovariance", twist=velocity, covariance=zero),
    )
    moved = _make("geometry_msgs/msg/Transform", translation=_vector(position), rotation=rotation)
    stamped = _make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=BODY, transform=moved)
    yield _encode("/tf", _TF, transforms=[stamped])


def body_rates(before: VehicleState, after: VehicleState, time: float) -> NDArray[np.float64]:
    """Return the constant body rates [rad/s], shape [3], that turn one attitude into the other within `time` [s]."""
    (w0, *v0), (w1, *v1) = np.asarray(before.quaternion, float), np.asarray(after.quaternion, float)
    w = w0 * w1 + np.dot(v0, v1)  # conj(q0) (x) q1
    v = (w0 * np.array(v1) - w1 * np.array(v0) - np.cross(v0, v1)) * (1.0 if w >= 0.0 else -1.0)
    sine = float(np.linalg.norm(v))
    return v * (2.0 * np.arctan2(sine, abs(w)) / (sine * time)) if sine > 0.0 else v


def true_state(frame: Frame) -> VehicleState:
    """Return the true state where it is known, else the estimated one."""
    return frame.observation.true_state or frame.observation.state


def encode_sweep(frame: Frame, points: NDArray[np.float32], stamp: int) -> Encoded:
    """Return /sweep: `points` [m], shape [P, 3], world frame, as the drone sees them at `stamp` [ns]."""
    state = true_state(frame)
    seen = (points - np.asarray(state.position, float)) @ matrices(np.asarray(state.quaternion, float))
    fields = [
        _make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    return _encode(
        "/sweep",
        _CLOUD,
        header=_header(stamp, BODY),
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=12,
        row_step=12 * len(points),
        data=np.frombuffer(seen.astype("<f4").tobytes(), np.uint8),
        is_dense=True,
    )


def encode_plan(frame: Frame, stamp: int) -> Iterator[Encoded]:
    """Yield what was planned: /plan (costs), /plan/best (the path flown), /plan/guides and /plan/rollouts."""
    plan, header = frame.plan, _header(stamp, WORLD)
    best = int(plan.best)
    yield _encode(
        "/plan",
        PLAN,
        header=header,
        kinds=list(plan.kinds),
        best=best,
        status=int(plan.status),
        stage2_cost=_floats(plan.stage2_cost),
        goal_cost=_floats(plan.goal_cost),
        collision_cost=_floats(plan.collision_cost),
        clearance=_floats(plan.clearance.min(axis=1)),
        command=_floats(plan.command[0]),
        plan_ms=float(frame.timings_ms.get("plan", 0.0)),
        config_version=frame.config_version,
    )
    poses = [
        _make(
            "geometry_msgs/msg/PoseStamped",
            header=header,
            pose=_make(
                "geometry_msgs/msg/Pose",
                position=_vector(p, "Point"),
                orientation=_make("geometry_msgs/msg/Quaternion", **dict(zip("wxyz", q, strict=True))),
            ),
        )
        for p, q in zip(plan.positions[best].tolist(), plan.quaternions[best].tolist(), strict=True)
    ]
    yield _encode("/plan/best", _PATH, header=header, poses=poses)
    yield _lines("/plan/guides", header, plan.guides, best=None, color=_GUIDE_COLOR)
    yield _lines("/plan/rollouts", header, plan.positions, best=best, color=_ROLLOUT_COLOR)


def _lines(topic: str, header: Any, lines: NDArray[Any], *, best: int | None, color: tuple[float, ...]) -> Encoded:
    """One line strip per instance, shape [M, n, 3]; a line keeps its id from tick to tick."""
    markers = []
    empty = np.zeros(0, np.uint8)
    image = _make("sensor_msgs/msg/CompressedImage", header=_header(0, ""), format="", data=empty)
    for i, line in enumerate(lines.tolist()):
        red, green, blue, opacity = _BEST_COLOR if i == best else color
        markers.append(
            _make(
                "visualization_msgs/msg/Marker",
                header=header,
                ns=topic.rpartition("/")[2],
                id=i,
                type=_LINE_STRIP,
                action=0,
                pose=_make(
                    "geometry_msgs/msg/Pose",
                    position=_vector((0.0, 0.0, 0.0), "Point"),
                    orientation=_make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                ),
                scale=_vector((0.05 if i == best else 0.02, 0.0, 0.0)),
                color=_make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=opacity),
                lifetime=_make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
                frame_locked=False,
                points=[_vector(point, "Point") for point in line],
                colors=[],
                texture_resource="",
                texture=image,
                uv_coordinates=[],
                text="",
                mesh_resource="",
                mesh_file=_make("visualization_msgs/msg/MeshFile", filename="", data=empty),
                mesh_use_embedded_materials=False,
            )
        )
    return _encode(topic, _MARKERS, markers=markers)


def _make(kind: str, **fields: Any) -> Any:
    return _store().types[kind](**fields)


def _encode(topic: str, kind: str, **fields: Any) -> Encoded:
    return Encoded(topic, kind, bytes(_store().serialize_cdr(_make(kind, **fields), kind)))


def _header(stamp: int, frame: str) -> Any:
    time = _make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return _make("std_msgs/msg/Header", stamp=time, frame_id=frame)


def _vector(values: Any, kind: str = "Vector3") -> Any:
    x, y, z = values
    return _make(f"geometry_msgs/msg/{kind}", x=float(x), y=float(y), z=float(z))


def _floats(values: Any) -> NDArray[np.float32]:
    return np.ascontiguousarray(values, np.float32)
