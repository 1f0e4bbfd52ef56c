"""A node in a real graph: discovery, qualities of service, and what is said where ROS 2 is missing."""

from __future__ import annotations

import sys
from typing import Any

import pytest

from aero_viz.errors import UserError
from aero_viz.ros.graph import Graph, Quality, Topic, message_class
from tests.ros.conftest import Start, wait_until

STRING = "std_msgs/msg/String"


def test_topics_of_other_processes_are_found(graph: Graph, start: Start):
    start("tests.ros.publisher", "/a=reliable", "/b=best_effort")
    graph.publisher("/own", STRING)
    wait_until(
        lambda: (
            [t for t in graph.topics() if STRING in t.types] == [Topic("/a", (STRING,), 1), Topic("/b", (STRING,), 1)]
        )
    )
    wait_until(lambda: graph.nodes("/a") == ["/texts"])


@pytest.mark.parametrize("qualities", [["reliable"], ["best_effort"], ["latched"], ["best_effort", "latched"]])
def test_a_subscription_suits_every_publisher(graph: Graph, start: Start, qualities: list[str]):
    for quality in qualities:
        start("tests.ros.publisher", f"/text={quality}")
    wait_until(lambda: [t.publishers for t in graph.topics() if t.name == "/text"] == [len(qualities)])
    is_latched = qualities == ["latched"]
    assert graph.quality("/text", STRING) == Quality("best_effort" not in qualities, is_latched)
    received: list[str] = []
    graph.subscribe("/text", STRING, lambda message: received.append(message.data))
    wait_until(lambda: len(received) > 4)
    assert received[0].startswith("/text ")


def test_raw_messages_are_those_of_recordings(graph: Graph, start: Start):
    from aero_viz.recordings.ros_messages import decode_message

    start("tests.ros.publisher", "/text=reliable")
    wait_until(graph.topics)
    received: list[bytes] = []
    subscription = graph.subscribe("/text", STRING, received.append, raw=True)
    wait_until(lambda: received)
    assert decode_message(received[0], STRING, "cdr").data.startswith("/text ")
    graph.remove(subscription)
    graph.close()
    graph.close()


def test_two_graphs_of_one_process_reach_each_other(graph: Graph):
    received: list[str] = []
    with Graph("other") as other:
        other.subscribe("/text", STRING, lambda message: received.append(message.data))
        publisher = graph.publisher("/text", STRING, latched=True)
        wait_until(publisher.get_subscription_count)  # it asks for no earlier messages
        publisher.publish(message_class(STRING)(data="hello"))
        wait_until(lambda: received == ["hello"])


def test_a_missing_ros_is_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(UserError, match=r"need the extra 'ros': run pip install '\.\[ros\]'.*or source an installed"):
        Graph()


def test_a_missing_type_names_its_package():
    with pytest.raises(UserError, match=r"The messages px4_msgs/msg/X are not installed .* has the package px4_msgs"):
        message_class("px4_msgs/msg/X")


def test_a_domain_that_does_not_exist_is_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch):
    for number in (-1, 233):
        with pytest.raises(UserError, match=f"can't start in domain {number}: .*check ROS_DOMAIN_ID"):
            Graph(domain=number)
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    with pytest.raises(UserError, match="can't start in domain 233: domains are 0 to 232"):
        Graph()


def test_a_callback_that_fails_stops_no_other(graph: Graph, start: Start, caplog: pytest.LogCaptureFixture):
    received: list[str] = []

    def take(message: Any) -> None:
        received.append(message.data)
        raise RuntimeError("a message that nobody expected")

    start("tests.ros.publisher", "/text=reliable")
    graph.subscribe("/text", STRING, take)
    wait_until(lambda: len(received) > 2)
    assert "a message that nobody expected" in caplog.text
