"""Messages of a stream become poses, and sweeps in the world frame."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner import Arrival, Sweeps, VehicleState
from aero_planner.onboard.host_clock import HostClock
from aero_planner.plan_inputs import FARTHEST
from aero_planner.pose_track import PoseTrack
from aero_planner.quaternions import compose_transforms, conjugate, multiply, rotate, rotation_matrix
from aero_planner.sweeps import as_constant
from aero_viz.live.health import TopicHealth
from aero_viz.live.setup import Setup
from aero_viz.live.stream import LiveMessage, Stream
from aero_viz.recordings.clouds import read_cloud
from aero_viz.recordings.point_cloud2 import decode_points
from aero_viz.recordings.pose_messages import TRANSFORM_STAMPED, StampedPose, decode_poses
from aero_viz.recordings.poses import MIN_DIFFERENCE_TIME, POSE_TOLERANCE
from aero_viz.recordings.ros_messages import TF_TYPES, DamagedMessage
from aero_viz.recordings.source import MAX_POINTS, MAX_POSE_SPACING
from aero_viz.recordings.transforms import IDENTITY, Transform

Array = NDArray[np.float64]

_POSES = 2048
"""Poses that are kept: 20 s at 100 Hz."""
_WAIT = 0.3
"""Longest time for which a sweep waits for the pose at its end [s]."""
_SET_CLOCK = 1.0
"""Step of the stamps, beyond that of the arrivals, from which a clock was set [s]."""
_WAITING_MAX = 32
"""Sweeps that may wait for a pose."""


class Inputs(NamedTuple):
    """Newest inputs of a planner, on the clock of the stamps."""

    time: float
    """[s] since the first pose or sweep."""
    state: VehicleState
    sweeps: Sweeps
    cloud_age: float
    """Time since the end of the newest sweep [s]."""
    stamp: int
    """Stamp of the newest sweep as it was published [ns]."""


class _Sweep(NamedTuple):
    """A sweep that waits for its pose."""

    points: NDArray[np.float32]
    """Body frame [m], [P, 3], or world frame."""
    time: float
    times: Array | None
    """Time of each point [s], None where unknown."""
    end: float
    arrival: int
    stamp: int


class Assembler:
    """Places sweeps by the poses at their own times. Garbage is left out, and counted by its reason.

    Use it from one thread.

    Args:
        stream: counts what is left out.
        setup: how to read the messages.
        sweeps: largest number of sweeps in the cloud.
    """

    def __init__(self, stream: Stream, setup: Setup, *, sweeps: int = 10) -> None:
        self.setup = setup
        self._stream, self._limit = stream, sweeps
        self._zero: int | None = None
        self._edges: dict[tuple[str, str], Transform] = {}
        self._clear()

    def _clear(self) -> None:
        """Discard all poses and sweeps: a clock was set, or another run has begun."""
        self._track = PoseTrack(_POSES)
        self._velocity = np.zeros(3)
        self._pose_arrival = 0
        self._waiting: deque[_Sweep] = deque()
        self._newest: _Sweep | None = None
        self._placed: deque[tuple[NDArray[np.float32], Arrival]] = deque()
        self._sweeps = Sweeps()
        self._clocks: dict[str, HostClock] = {}
        self._last: dict[str, float] = {}

    @property
    def has_inputs(self) -> bool:
        """True if there is a sweep, and a pose if poses are expected."""
        return bool(self._placed) and (self.setup.poses is None or len(self._track) > 0)

    def add(self, message: LiveMessage) -> None:
        """Take a message of the topics that are used; others are ignored."""
        setup, health = self.setup, self._stream.topics[message.topic]
        try:
            if message.topic == setup.points:
                if message.type != setup.points_type:
                    raise DamagedMessage(f"it is {message.type} now: start aero-viz live again")
                self._add_cloud(message, health)
            elif message.topic == setup.poses:
                self._add_poses(message, health)
        except DamagedMessage as error:
            health.refuse(str(error))
        except ValueError:
            health.refuse("its bytes are damaged")

    def _add_cloud(self, message: LiveMessage, health: TopicHealth) -> None:
        setup = self.setup
        cloud = read_cloud(message.data, message.type, "cdr", setup.camera)
        time = self._time(cloud.stamp, message, health)
        if time is None:
            return
        origin = setup.offset if setup.in_world and setup.offset.any() else None
        decoded = decode_points(cloud, unit=setup.time_unit, origin=origin)
        points = decoded.points
        if not len(points):
            reason = "none of its points is valid" if decoded.dropped else "it has no points"
            health.refuse(reason)
            return
        if cloud.frame != setup.cloud_frame:
            if cloud.frame not in setup.other_frames:
                health.refuse(f"no static transform joins its frame {cloud.frame!r} and {setup.cloud_frame!r}")
                return
            points = setup.other_frames[cloud.frame].move(points)
        if not setup.in_world and setup.extrinsic is not IDENTITY:
            points = setup.extrinsic.move(points)
        times = None if decoded.times is None or setup.in_world else time + decoded.times.astype(np.float64)
        if setup.mask is not None and not setup.in_world:
            kept = ~((points >= setup.mask[0]) & (points <= setup.mask[1])).all(axis=1)
            points, times = points[kept], None if times is None else times[kept]
        end = time if times is None or not len(times) else float(times.max())
        if len(self._waiting) == _WAITING_MAX:
            self._waiting.popleft()
            health.refuse("no pose arrives for it")
        self._waiting.append(_Sweep(points, time, times, end, message.time, cloud.stamp))

    def _add_poses(self, message: LiveMessage, health: TopicHealth) -> None:
        setup = self.setup
        poses = decode_poses(message.data, message.type, "cdr")
        if message.type in TF_TYPES:
            moved = [pose for pose in poses if self._move_edge(pose)]
            if moved and (chain := self._chain()) is not None:
                self._add_pose(moved[-1]._replace(values=(*chain.position, *chain.quaternion, *[np.nan] * 3)), message)
            return
        for pose in poses:
            if defect := pose.defect:
                health.refuse(defect)
            elif message.type == TRANSFORM_STAMPED or pose.child in ("", setup.body):
                self._add_pose(pose, message)

    def _move_edge(self, pose: StampedPose) -> bool:
        """Take a transform of the chain to the body; return True if it moves the body."""
        edge = (pose.parent, pose.child)
        if edge not in self.setup.edges or pose.defect:
            return False
        self._edges[edge] = Transform(np.array(pose.values[:3]), np.array(pose.values[3:7]))
        return edge == self.setup.edges[0]

    def _chain(self) -> Transform | None:
        """Return the pose of the body in the world by the newest transforms, None while one is missing."""
        pose = IDENTITY
        for edge in self.setup.edges:
            if edge not in self._edges:
                return None
            pose = Transform(*compose_transforms(*self._edges[edge], *pose))
        return pose

    def _add_pose(self, pose: StampedPose, message: LiveMessage) -> None:
        setup = self.setup
        time = self._time(pose.stamp, message, self._stream.topics[message.topic])
        if time is None:
            return
        position = np.array(pose.values[:3]) - setup.offset
        if np.abs(position).max() > FARTHEST:
            self._stream.topics[message.topic].refuse("its position is too far from the first one")
            return
        quaternion = np.array(pose.values[3:7])
        quaternion /= np.linalg.norm(quaternion)
        if setup.turn is not None:
            quaternion = multiply(quaternion, conjugate(setup.turn))
        if not self._track.append(time, position, quaternion):
            return
        self._pose_arrival = message.time
        twist = np.array(pose.values[7:])
        if setup.twist == "none" or not np.isfinite(twist).all():
            self._velocity = self._difference(time, position)
        elif setup.twist == "world":
            self._velocity = twist
        else:
            twist = twist if setup.turn is None else rotate(setup.turn, twist)
            self._velocity = rotate(quaternion, twist)

    def _difference(self, time: float, position: Array) -> Array:
        """Return the mean velocity since a pose that is at least `MIN_DIFFERENCE_TIME` older [m/s], world frame."""
        times = self._track.times
        before = int(np.searchsorted(times, time - MIN_DIFFERENCE_TIME, side="right")) - 1
        before = max(before, 0)
        step = time - float(times[before])
        return (position - self._track.positions[before]) / step if step > 1e-6 else np.zeros(3)

    def _time(self, stamp: int, message: LiveMessage, health: TopicHealth) -> float | None:
        """Return the time of a message [s]; None if its stamp fits neither its arrival nor those before it."""
        if self.setup.stamped and stamp == 0:
            health.refuse("its stamp is not set")
            return None
        time = stamp if self.setup.stamped else message.time
        if self._zero is None:
            self._zero = time
        seconds = (time - self._zero) * 1e-9
        clock = self._clocks.setdefault(message.topic, HostClock(jump=_SET_CLOCK))
        last = self._last.get(message.topic)
        if clock.to_host(seconds, (message.time - self._zero) * 1e-9) is None:
            is_back = last is not None and seconds < last
            health.refuse("its stamp steps back" if is_back else "its stamp is in the future")
            return None
        if last is not None and seconds < last - _SET_CLOCK:
            self._clear()  # many stamps in a row agree with one another: another run has begun
        self._last[message.topic] = seconds
        return seconds

    def inputs(self, now: int) -> Inputs:
        """Return the newest inputs at a time of arrival [ns]. There must be some, see `has_inputs`."""
        self.place(now)
        newest = self._newest
        assert newest is not None
        if self.setup.poses is None:
            time = newest.end + max(now - newest.arrival, 0) * 1e-9
            state = VehicleState(np.zeros(3), np.zeros(3), (1.0, 0.0, 0.0, 0.0), time=time)
        else:
            age = max(now - self._pose_arrival, 0) * 1e-9
            time = self._track.newest_time + age
            position = self._track.positions[-1] + min(age, POSE_TOLERANCE) * self._velocity
            state = VehicleState(position, self._velocity.copy(), self._track.quaternions[-1].copy(), time=time)
        return Inputs(time, state, self._sweeps, max(time - newest.end, 0.0), newest.stamp)

    def place(self, now: int) -> None:
        """Place the sweeps whose poses have arrived, or that have waited long enough at `now` [ns]."""
        placed = False
        while self._waiting:
            sweep = self._waiting[0]
            is_late = (now - sweep.arrival) * 1e-9 > _WAIT
            must_wait = self.setup.poses is not None and not self.setup.in_world
            if must_wait and not is_late and self._track.newest_time < sweep.end:
                break
            self._waiting.popleft()
            points = self._place(sweep)
            if points is None:
                self._stream.topics[self.setup.points].refuse("no pose covers it")
                continue
            place = self._track.interpolate(sweep.end)[0].tolist() if len(self._track) else [0.0, 0.0, 0.0]
            self._placed.append((as_constant(points), Arrival(sweep.end, (place[0], place[1], place[2]))))
            self._newest, placed = sweep, True
        if placed:
            self._limit_cloud()

    def _limit_cloud(self) -> None:
        total, count = 0, 0
        for points, _ in reversed(self._placed):
            total += len(points)
            if count and (count == self._limit or total > MAX_POINTS):
                break
            count += 1
        while len(self._placed) > count:
            self._placed.popleft()
        sweeps, arrivals = zip(*self._placed, strict=True)
        self._sweeps = Sweeps(sweeps, arrivals=arrivals)

    def _place(self, sweep: _Sweep) -> NDArray[np.float32] | None:
        """Return the points of a sweep in the world frame [m], None if no pose covers it."""
        track = self._track
        if self.setup.poses is None or self.setup.in_world:
            return sweep.points
        if not len(track) or sweep.end < track.times[0] - POSE_TOLERANCE or sweep.time > track.newest_time + _WAIT:
            return None
        if sweep.times is not None and len(sweep.times):
            points, known = track.deskew(sweep.points, sweep.times, max_gap=MAX_POSE_SPACING)
            if 2 * np.count_nonzero(known) > len(known):
                return points[known]
        position, quaternion = track.interpolate(sweep.time)
        return sweep.points @ rotation_matrix(quaternion).T.astype(np.float32) + position.astype(np.float32)
