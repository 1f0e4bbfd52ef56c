"""What the stamps and arrivals of a topic tell about its publisher."""

from __future__ import annotations

import pytest

from aero_planner.onboard.ros_messages import pose_messages
from aero_planner.plan import VehicleState
from aero_viz.live.health import TopicHealth
from aero_viz.live.stream import Stream

SECOND = 1_000_000_000


def fed(stamps: list[float], *, ahead: float = 0.0) -> tuple[TopicHealth, int]:
    """Return a topic with messages at these times [s], whose publisher's clock is ahead [s], and the time [ns]."""
    health = TopicHealth("/points", "sensor_msgs/msg/PointCloud2")
    for stamp in stamps:
        health.add(round((100.0 + stamp + ahead) * SECOND), round((100.01 + stamp) * SECOND))
    return health, round((100.01 + max(stamps)) * SECOND)


TENTHS = [0.1 * k for k in range(40)]


@pytest.mark.parametrize(
    ("stamps", "ahead", "said"),
    [
        (TENTHS, 0.0, ""),
        (TENTHS, 3.0, "the stamps on /points are 3.0 s ahead of this computer's clock"),
        (TENTHS, -3.0, "the stamps on /points are 3.0 s behind this computer's clock"),
        ([*TENTHS[:20], *TENTHS[24:]], 0.0, "about 4 messages on /points are missing, by the gaps between stamps"),
        ([*TENTHS[:20], TENTHS[19], *TENTHS[20:]], 0.0, "1 stamps on /points are not later than the one before"),
    ],
)
def test_clocks_gaps_and_repeated_stamps_are_said(stamps: list[float], ahead: float, said: str):
    health, now = fed(stamps, ahead=ahead)
    assert health.sentences(now) == ([said] if said else [])
    assert health.period == pytest.approx(0.1)


def test_what_is_over_is_not_said_for_ever():
    health, now = fed([*TENTHS[:20], *TENTHS[24:]])
    later, now = fed([*TENTHS[:20], *[0.1 * k for k in range(24, 200)]])
    assert health.missing == later.missing == 4 and later.sentences(now) == []


def test_many_may_publish_tf_each_with_its_own_times():
    transforms = pose_messages(VehicleState((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), 100 * SECOND)
    (data,) = (message.data for message in transforms if message.topic == "/tf")
    for kind, count in (("tf2_msgs/msg/TFMessage", 0), ("nav_msgs/msg/Odometry", 1)):
        stream = Stream("graph")
        for _ in range(30):
            stream.add("/tf", kind, data)
        health = stream.health("/tf", kind)
        health.publishers = ("/a", "/b")
        found = [text for text in health.sentences(stream.clock.now()) if "publish" in text]
        assert (len(found), health.behind) == (count, 29 * count)
