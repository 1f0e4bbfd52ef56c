"""A stream of real ROS 2: drivers in other processes, their qualities of service, restarts, garbage and rates."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aero_viz.live.session import StreamSession
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource
from aero_viz.live.stream import Stream
from aero_viz.ros.feed import Feed
from aero_viz.ros.graph import Graph, message_class
from aero_viz.session.frame import Frame
from tests.ros.conftest import Start, wait_until

TOPICS = {"/points": "sensor_msgs/msg/PointCloud2", "/odometry": "nav_msgs/msg/Odometry"}
DRIVER = "tests.ros.driver"

Open = Callable[..., StreamSession]


@pytest.fixture
def stream(graph: Graph) -> Stream:
    return Stream("graph")


@pytest.fixture
def feed(graph: Graph, stream: Stream) -> Iterator[Feed]:
    made = Feed(graph, stream)
    yield made
    made.close()


def count(stream: Stream, topic: str) -> int:
    """Return how many messages have arrived on a topic."""
    health = stream.topics.get(topic)
    return 0 if health is None else health.count


@pytest.fixture
def open_session(feed: Feed, stream: Stream) -> Iterator[Open]:
    """Return a session of the topics, once a second of them has arrived; arguments are those of `StreamSource`."""
    sessions: list[StreamSession] = []

    def make(**options: object) -> StreamSession:
        feed.use(TOPICS)
        wait_until(lambda: count(stream, "/points") > 10)
        setup = find_setup(stream, Wanted())
        sessions.append(StreamSession(StreamSource(stream, setup, **options)))  # type: ignore[arg-type]
        return sessions[-1]

    yield make
    for session in sessions:
        session.close()


def collect(session: StreamSession) -> list[Frame]:
    """Start a session and return the list to which its ticks are added."""
    frames: list[Frame] = []
    session.subscribe_ticks(frames.append, name="test")
    session.start()
    wait_until(lambda: frames)
    return frames


def test_a_drivers_topics_are_found_and_planned_on(feed: Feed, start: Start, open_session: Open):
    start(DRIVER)
    wait_until(lambda: feed.candidates() == TOPICS)
    frames = collect(open_session())
    wait_until(lambda: len(frames) > 5)
    frame = frames[-1]
    assert abs(float(np.asarray(frame.observation.state.velocity)[0])) == pytest.approx(1.0)
    assert len(frame.observation.sweeps) == 10
    assert np.isfinite(frame.plan.cost).all()


@pytest.mark.parametrize("driver", [["--best-effort"], []])
def test_both_qualities_of_service_are_received(feed: Feed, start: Start, stream: Stream, driver: list[str]):
    feed.use(TOPICS)  # before there is a publisher
    start(DRIVER, *driver)
    wait_until(lambda: count(stream, "/points") > 3 and count(stream, "/odometry") > 10)


def test_a_driver_that_returns_with_another_quality_is_heard_again(
    graph: Graph, start: Start, stream: Stream, open_session: Open
):
    first = start(DRIVER)
    session = open_session()
    frames = collect(session)
    first.terminate()
    first.wait(20)
    wait_until(lambda: "/points is silent" in (frames[-1].explanation or ""))
    before = count(stream, "/points")
    start(DRIVER, "--best-effort")
    wait_until(lambda: count(stream, "/points") > before + 5)
    wait_until(lambda: frames[-1].explanation is None or "silent" not in frames[-1].explanation)
    wait_until(lambda: frames[-1].observation.cloud_age < 1.0)


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("nan", "none of its points is valid"),
        ("empty", "it has no points"),
        ("wrong_step", "do not fit into"),
        ("future", "its stamp is in the future"),
    ],
)
def test_garbage_is_counted_and_named(start: Start, stream: Stream, open_session: Open, kind: str, reason: str):
    driver = start(DRIVER)
    frames = collect(open_session())
    order(driver, kind)
    wait_until(lambda: stream.topics["/points"].unused)
    (found,) = stream.topics["/points"].unused
    assert reason in found and stream.topics["/points"].unused[found] == 1
    wait_until(lambda: reason in (frames[-1].explanation or ""))


def order(driver: subprocess.Popen[str], line: str) -> None:
    assert driver.stdin is not None
    driver.stdin.write(f"{line}\n")
    driver.stdin.flush()


def test_two_publishers_of_one_topic_are_named(start: Start, open_session: Open):
    start(DRIVER, "--node", "first")
    start(DRIVER, "--node", "second", "--no-odometry")
    frames = collect(open_session())
    wait_until(lambda: "2 nodes publish /points: /first, /second" in (frames[-1].explanation or ""))


def test_clouds_of_the_world_are_known_by_their_frame(start: Start, open_session: Open):
    start(DRIVER, "--in-world")
    session = open_session()
    assert session.stream_source.setup.in_world
    assert any("'odom', which is that of the poses" in text for text in session.stream_source.setup.assumptions)


def test_no_cloud_of_20000_points_is_lost(start: Start, stream: Stream, open_session: Open):
    # The minute at 50 Hz of planning is benchmarks/live.py.
    sent = 40
    driver = start(DRIVER, "--points", "20000", "--clouds", str(sent), "--wait")
    collect(open_session(rate=50.0))
    driver.wait(60)
    wait_until(lambda: count(stream, "/points") >= sent)
    assert count(stream, "/points") == sent and not stream.topics["/points"].unused


def test_only_what_is_used_is_subscribed_to(graph: Graph, feed: Feed, start: Start, stream: Stream):
    start(DRIVER)
    feed.use(TOPICS)
    wait_until(lambda: count(stream, "/odometry"))
    feed.use({"/points": TOPICS["/points"]})
    assert feed.topics == {"/points": TOPICS["/points"]}
    wait_until(lambda: graph.node.count_subscribers("/odometry") == 0)


def test_clouds_that_nobody_uses_are_not_subscribed_to(
    graph: Graph, start: Start, stream: Stream, feed: Feed, open_session: Open, tmp_path: Path
):
    start(DRIVER)
    session, shown = open_session(), threading.Event()
    session.rest_unless(shown.is_set, feed.rest, delay=0.1)
    frames = collect(session)

    def rest() -> None:
        session.pause()
        wait_until(lambda: graph.node.count_subscribers("/points") == 0)

    def resumed() -> Frame:
        before = len(frames)
        wait_until(lambda: len(frames) > before + 2 and frames[-1].observation.cloud_age < 0.5)
        assert graph.node.count_subscribers("/points") == 1
        return frames[-1]

    resumed()  # nobody looks, but the picture follows
    rest()
    assert session.rests and graph.node.count_subscribers("/odometry") == 1
    time.sleep(2.0)
    shown.set()
    resumed()
    assert stream.topics["/points"].missing < 10  # the gap is no fault of the driver
    assert session.frame is not frames[-1]  # the picture is still held
    shown.clear()
    rest()
    session.play()
    resumed()
    rest()
    recorder = session.record(tmp_path / "rest.mcap").result()
    resumed()
    wait_until(lambda: recorder.ticks > 3)
    session.stop_recording().result()
    wait_until(lambda: session.rests)


def goal_of(frame: Frame) -> list[float]:
    return np.asarray(frame.observation.goal.position).tolist()


def test_a_goal_comes_from_a_topic(graph: Graph, feed: Feed, start: Start, open_session: Open):
    start(DRIVER)
    session = open_session(goal_topic="/goal_pose")
    kind = "geometry_msgs/msg/PoseStamped"
    feed.use({**TOPICS, "/goal_pose": kind})
    frames = collect(session)
    with Graph("rviz") as other:
        publisher, goal = other.publisher("/goal_pose", kind), message_class(kind)()
        goal.pose.position.x, goal.pose.position.y = 12.0, 1.0
        wait_until(publisher.get_subscription_count)
        publisher.publish(goal)
        wait_until(lambda: goal_of(frames[-1])[:2] == [12.0, 1.0])
    assert goal_of(frames[-1])[2] == pytest.approx(1.5)  # RViz sends z = 0


def test_a_goal_follows_a_topic_of_another_type_that_comes_later(feed: Feed, start: Start, open_session: Open):
    start(DRIVER)
    session = open_session(goal_topic="/leader")
    feed.use({**TOPICS, "/leader": "geometry_msgs/msg/PoseStamped"})  # nobody publishes it yet
    frames = collect(session)
    start(DRIVER, "--odometry-topic", "/leader", "--cloud-topic", "/other", "--node", "leader")
    wait_until(lambda: goal_of(frames[-1])[2] == 1.5 and abs(goal_of(frames[-1])[0] - 15.0) > 5.0)


def test_the_session_sleeps_until_the_next_tick_is_due(start: Start, open_session: Open):
    start(DRIVER)
    frames = collect(open_session(rate=5.0))
    time.sleep(1.0)
    before = len(frames)
    time.sleep(2.0)
    assert len(frames) - before <= 11
