"""Clouds of a driver in ROS 2 as the points of the LiDAR."""

from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aero_planner.onboard.host_clock import HostClock
from aero_planner.onboard.ros_points import RosPoints, decode_cloud, decode_custom
from tests.planner.onboard.ros_driver import cloud_message

XYZ = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [0.0, 0.0, 0.0], [np.nan, 1.0, 1.0]])


def cloud(**options: Any) -> Any:
    return cloud_message(XYZ, **options)


def custom(offsets: Any = (0, 10_000_000, 0, 0), tags: Any = (0, 0, 0, 0)) -> bytes:
    """The bytes of a livox_ros_driver2/CustomMsg."""
    frame = b"livox_frame\0"
    head = b"\0\1\0\0" + struct.pack("<iII", 100, 0, len(frame)) + frame
    body = bytearray(head + bytes(-(len(head) - 4) % 8) + struct.pack("<QIB3xI", 100 * 10**9, 4, 1, 4))
    for (x, y, z), offset, tag in zip(XYZ, offsets, tags, strict=True):
        body += bytes(-(len(body) - 4) % 4) + struct.pack("<IfffBBB", offset, x, y, z, 7, tag, 0)
    return bytes(body)


@pytest.mark.parametrize(
    "columns",
    [
        {"timestamp": ("f8", 100e9 + np.arange(4) * 1e7), "tag": ("u1", 0)},
        {"timestamp": ("f8", 100.0 + np.arange(4) * 0.01)},
        {"t": ("u4", np.arange(4) * 10_000_000)},
        {"offset_time": ("u4", np.arange(4) * 10_000_000), "order": ">"},
        {"time": ("f4", np.arange(4) * 0.01)},
    ],
    ids=["livox", "absolute", "relative", "big-endian", "seconds"],
)
def test_every_point_has_its_time(columns: dict[str, Any]):
    points, stamps, _ = decode_cloud(cloud(**columns))
    np.testing.assert_array_equal(points, XYZ.astype(np.float32))
    np.testing.assert_allclose(stamps, 100.0 + np.arange(4) * 0.01, atol=1e-6)


def test_the_driver_of_livox_is_read_from_its_bytes():
    points, stamps, tags = decode_custom(custom(tags=(1, 2, 3, 0)))
    np.testing.assert_array_equal(points, XYZ.astype(np.float32))
    np.testing.assert_allclose(stamps, [100.0, 100.01, 100.0, 100.0])
    np.testing.assert_array_equal(tags, [1, 2, 3, 0])


def test_points_have_host_times_and_returns_only():
    time = 50.0
    source = RosPoints(HostClock(), lambda: time)
    source.receive(cloud(t=("u4", [0, 10_000_000, 0, 0])))
    time = 50.1
    source.receive_custom(custom(tags=(0b100000, 0, 0, 0)))  # the first one is likely noise
    first, second = source.poll()
    np.testing.assert_allclose(first.times, [49.99, 50.0])
    np.testing.assert_array_equal(first.points, XYZ[:2].astype(np.float32))
    assert len(second.points) == 1 and source.poll() == []
    counters = source.counters
    assert (counters.packets, counters.points, counters.filtered, counters.bad) == (2, 3, 5, 0)


def broken(**changes: Any) -> Any:
    return SimpleNamespace(**{**vars(cloud(t=("u4", 0))), **changes})


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (cloud(), "xfer_format"),
        (cloud(t=("u4", 0), frame="camera_init"), "lidar.topic"),
        (broken(point_step=15), "do not fit"),
        (broken(width=10**9), "do not fit"),
        (broken(fields=[]), "x, y, z"),
        (broken(data=b""), "do not fit"),
    ],
)
def test_what_is_no_sweep_of_a_sensor_is_refused_with_the_reason(
    message: Any, text: str, caplog: pytest.LogCaptureFixture
):
    source = RosPoints(HostClock(), lambda: 50.0)
    for _ in range(3):
        source.receive(message)
    assert source.poll() == [] and source.counters.bad == 3
    assert len(caplog.messages) == 1 and text in caplog.messages[0]


def test_cut_or_scrambled_bytes_are_refused():
    source, data = RosPoints(HostClock(), lambda: 50.0), custom()
    for size in range(0, len(data), 3):
        source.receive_custom(data[:size])
        source.poll()
    source.receive_custom(b"\0\0" + data[2:])
    assert source.poll() == [] and source.counters.packets == 0


def test_messages_that_nobody_takes_are_lost_not_kept():
    source = RosPoints(HostClock(), lambda: 50.0)
    for _ in range(100):
        source.receive(cloud(t=("u4", 0)))
    assert 0 < len(source.poll()) < 30 and source.counters.lost == 100 - source.counters.packets
