"""Samples of an IMU as sensor_msgs/Imu."""

from __future__ import annotations

from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aero_viz.recordings.ros_messages import encode_message, message_type

IMU_TYPE = "sensor_msgs/msg/Imu"
GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""


class ImuRows:
    """A growing list of samples, 56 bytes each.

    Args:
        topic: topic that they are read on.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.stamps = array("q")
        """[ns]."""
        self._values = array("d")

    def add(self, stamp: int, rates: Sequence[float], forces: Sequence[float]) -> None:
        """Append angular velocities [rad/s] and specific forces [m/s^2] at a time [ns], unless the time is absurd."""
        if stamp < 1 << 63:
            self.stamps.append(stamp)
            self._values.extend((*rates, *forces))

    def encode(self, index: int, frame: str) -> bytes:
        """Return a sample as a message in CDR."""
        values = self._values[6 * index : 6 * index + 6]
        return encode_imu(self.stamps[index], frame, values[:3], values[3:])


def encode_imu(
    stamp: int, frame: str, rates: Sequence[float] | NDArray[np.float64], forces: Sequence[float] | NDArray[np.float64]
) -> bytes:
    """Return a sensor_msgs/Imu without orientation as CDR.

    Args:
        stamp: [ns].
        frame: frame of the vectors.
        rates: angular velocity [3] [rad/s].
        forces: specific force [3] [m/s^2].
    """
    vector = message_type("geometry_msgs/msg/Vector3")
    time = message_type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
    unknown = np.zeros(9)
    message = message_type(IMU_TYPE)(
        header=message_type("std_msgs/msg/Header")(stamp=time, frame_id=frame),
        orientation=message_type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *np.zeros(8)]),  # no orientation is measured
        angular_velocity=vector(*map(float, rates)),
        angular_velocity_covariance=unknown,
        linear_acceleration=vector(*map(float, forces)),
        linear_acceleration_covariance=unknown,
    )
    return encode_message(message, IMU_TYPE)
