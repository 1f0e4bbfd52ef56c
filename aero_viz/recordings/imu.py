"""Samples of an inertial measurement unit (IMU) in a recording."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_viz.recordings.bag_file import BagFile
from aero_viz.recordings.imu_messages import GRAVITY, IMU_TYPE
from aero_viz.recordings.ros_messages import ENCODINGS, DamagedMessage, decode_message

_LARGEST_IN_G = 3.0
"""A median specific force below this is in units of g, as Livox's driver writes it, not in m/s^2."""


class ImuSamples(NamedTuple):
    """The samples of one IMU in the order of their times."""

    topic: str
    frame: str
    """Frame of the vectors."""
    times: NDArray[np.int64]
    """Stamps [n] [ns]."""
    forces: NDArray[np.float64]
    """Specific forces [n, 3] [m/s^2]: gravity upwards at rest."""
    rates: NDArray[np.float64]
    """Angular velocities [n, 3] [rad/s]."""


def read_imu(files: list[BagFile]) -> ImuSamples | None:
    """Return the intact samples on the busiest topic of type sensor_msgs/Imu, None if there are none."""
    rows: dict[str, list[tuple[float, ...]]] = {}
    stamps: dict[str, list[int]] = {}
    frames: dict[str, str] = {}
    for file in files:
        for found in file.scan({IMU_TYPE}):
            channel = found.channel
            if channel.type != IMU_TYPE or channel.encoding not in ENCODINGS:
                continue
            try:
                whole = found.head if len(found.head) == found.size else file.read(found.position)
                message = decode_message(whole, IMU_TYPE, channel.encoding)
            except (DamagedMessage, ValueError):
                continue
            force, rate, stamp = message.linear_acceleration, message.angular_velocity, message.header.stamp
            values = (force.x, force.y, force.z, rate.x, rate.y, rate.z)
            rows.setdefault(channel.topic, []).append(values)
            stamps.setdefault(channel.topic, []).append(stamp.sec * 10**9 + stamp.nanosec or found.time)
            frames[channel.topic] = message.header.frame_id.lstrip("/")
    if not rows:
        return None
    topic = max(rows, key=lambda name: len(rows[name]))
    times, values = np.array(stamps[topic], np.int64), np.array(rows[topic], np.float64)
    valid = np.isfinite(values).all(axis=1)
    times, index = np.unique(times[valid], return_index=True)
    values = values[valid][index]
    if not len(times):
        return None
    forces = unit_of(values[:, :3]) * values[:, :3]
    return ImuSamples(topic, frames[topic], times, forces, values[:, 3:])


def unit_of(forces: NDArray[np.float64]) -> float:
    """Return the unit of specific forces, [n, 3], of a body that is mostly near rest [m/s^2]."""
    return GRAVITY if np.median(np.linalg.norm(forces, axis=1)) < _LARGEST_IN_G else 1.0
