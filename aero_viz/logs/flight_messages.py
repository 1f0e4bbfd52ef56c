"""The messages of a flight: every frame of a session as the ROS 2 messages that the drone logs, too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_planner import Sweeps, VehicleState
from aero_planner.onboard.ros_messages import Encoded, goal_message, plan_messages, pose_messages, sweep, wall_time
from aero_planner.quaternions import conjugate, multiply, rotation_matrix, rotation_vector
from aero_viz.session.frame import Frame

_SWEEP_STEP = 1000  # [ns] between the stamps of the sweeps of a cloud that is sent as a whole
_JUMP_STEP = 20_000_000  # [ns] between the stamps before and after a jump of the source's time


class FlightMessages:
    """Encodes frames in the order in which they are shown.

    The goal is encoded at the start and whenever it moves. A sweep is encoded once, when it is new; at the start and
    after a jump in time, all sweeps of the cloud are encoded. Stamps start at the wall time of creation, and continue
    to increase if the time of the source jumps back.
    """

    def __init__(self) -> None:
        self._base = self.stamp = round(1e9 * wall_time())  # stamp of source time 0
        """Stamp of the last frame [ns]."""
        self.last: Frame | None = None
        """The last frame."""
        self._pose: tuple[int, float, VehicleState] | None = None  # epoch, time [s] and state of the last pose
        self._sweeps: Sweeps | None = None  # of the last frame

    def encode(self, frame: Frame) -> list[tuple[Encoded, int]]:
        """Return the messages of a frame with their stamps [ns]."""
        messages = self.encode_inputs(frame)
        plan_ms, stamp = float(frame.timings_ms.get("plan", 0.0)), self.stamp
        plan = plan_messages(frame.plan, stamp, plan_ms=plan_ms, config_version=frame.config_version)
        return [*messages, *((message, stamp) for message in plan)]

    def encode_inputs(self, frame: Frame) -> list[tuple[Encoded, int]]:
        """Return the messages of a frame without its plan: pose, sweeps and goal, with their stamps [ns]."""
        last = self.last
        stamp = self._next_stamp(frame)
        messages: list[tuple[Encoded, int]] = []
        if last is None or last.epoch != frame.epoch or last.time != frame.time:
            messages += self._encode_pose(frame.time, frame.observation.actual_state, stamp, epoch=frame.epoch)
            messages += self._encode_sweeps(frame, stamp)
        if last is None or not np.array_equal(last.observation.goal.position, frame.observation.goal.position):
            messages.append((goal_message(frame.observation.goal, stamp), stamp))
        self.last = frame
        return messages

    def encode_pose(self, time: float, state: VehicleState) -> list[tuple[Encoded, int]]:
        """Return the messages with the pose of the drone between two frames, none before the first frame.

        Args:
            time: source time, later than that of the last frame [s].
            state: true state.
        """
        if self.last is None:
            return []
        return self._encode_pose(time, state, self._base + round(1e9 * time), epoch=self.last.epoch)

    def _encode_pose(self, time: float, state: VehicleState, stamp: int, *, epoch: int) -> list[tuple[Encoded, int]]:
        """Encode a pose once. Its body rates are the mean rates since the last pose, or zero after a jump in time."""
        rates = np.zeros(3)
        if self._pose is not None and self._pose[0] == epoch:
            if self._pose[1] >= time:
                return []
            rates = _body_rates(self._pose[2], state, time - self._pose[1])
        self._pose = (epoch, time, state)
        return [(message, stamp) for message in pose_messages(state, stamp, rates=rates)]

    def _next_stamp(self, frame: Frame) -> int:
        stamp = self._base + round(1e9 * frame.time)
        if self.last is not None and frame.epoch != self.last.epoch:
            self._base += self.stamp + _JUMP_STEP - stamp
            stamp = self.stamp + _JUMP_STEP
            self._sweeps = None
        self.stamp = stamp
        return stamp

    def _encode_sweeps(self, frame: Frame, stamp: int) -> list[tuple[Encoded, int]]:
        sweeps = frame.observation.sweeps
        if sweeps is self._sweeps:
            return []
        added = new_sweeps(self._sweeps, sweeps)
        self._sweeps = sweeps
        timed = ((points, stamp + i * _SWEEP_STEP) for i, points in enumerate(added))
        return [(_sweep_message(frame, points, at), at) for points, at in timed if len(points)]


def _body_rates(before: VehicleState, after: VehicleState, time: float) -> NDArray[np.float64]:
    """Return the constant body rates [rad/s], [3], that rotate one attitude into the other within `time` [s]."""
    return rotation_vector(multiply(conjugate(before.quaternion), after.quaternion)) / time


def _sweep_message(frame: Frame, points: NDArray[np.float32], stamp: int) -> Encoded:
    """Return the message with points [m], [P, 3], world frame, moved to the body frame at the time of the frame.

    It has no per-point times: motion within the sweep is already compensated, and a reader that deskewed the points
    again would smear them.
    """
    state = frame.observation.actual_state
    in_body = (points - np.asarray(state.position, float)) @ rotation_matrix(state.quaternion)
    return sweep(in_body.astype(np.float32), stamp)


def new_sweeps(before: Sweeps | None, sweeps: Sweeps) -> list[NDArray[np.float32]]:
    """Return the sweeps [m], [n, 3] each, that are new since the previous cloud; all of them if the two share none.

    From one cloud to the next, sweeps leave at the front and join at the end.

    Args:
        before: previous cloud; None if there is none.
        sweeps: present cloud.
    """
    held, present = list(before or ()), list(sweeps)
    for shared in range(min(len(held), len(present)), 0, -1):
        pairs = zip(held[-shared:], present, strict=False)
        if all(a is b or np.array_equal(a, b, equal_nan=True) for a, b in pairs):
            return present[shared:]
    return present
