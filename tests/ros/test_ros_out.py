"""`--ros-out` of the commands, as another program of the graph sees it while nobody opens the page."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus

from aero_planner.config import PlannerConfig
from aero_planner.onboard.ros_definitions import CLOUD, MARKERS, ODOMETRY, PATH
from aero_planner.quaternions import rotation_matrix
from aero_viz.recordings import open_recording
from aero_viz.ros.graph import Graph
from tests.cli.programs import interrupt
from tests.live.test_command import RECORDING
from tests.ros.conftest import points_of, wait_until

KINDS = {
    "/aero_viz/odometry": ODOMETRY,
    "/aero_viz/plan/best": PATH,
    "/aero_viz/plan/candidates": MARKERS,
    "/aero_viz/plan/cells": CLOUD,
    "/aero_viz/plan/filtered": CLOUD,
    "/aero_viz/command/velocity": "geometry_msgs/msg/TwistStamped",
    "/aero_viz/command/acceleration": "geometry_msgs/msg/AccelStamped",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
STEP = PlannerConfig().sampling.dt
"""Time between two points of a path [s]."""


def listen(graph: Graph) -> dict[str, dict[int, Any]]:
    """Return a dictionary to which the messages of every topic are added, by their stamps [ns]."""
    found: dict[str, dict[int, Any]] = {name: {} for name in KINDS}

    def take(name: str) -> Callable[[Any], None]:
        def add(message: Any) -> None:
            header = message.markers[0].header if hasattr(message, "markers") else message.header
            found[name][header.stamp.sec * 10**9 + header.stamp.nanosec] = message

        return add

    for name, kind in KINDS.items():
        graph.subscribe(name, kind, take(name))
    return found


def xyz(place: Any) -> list[float]:
    return [place.x, place.y, place.z]


@pytest.mark.parametrize(
    "command",
    [("play", RECORDING), ("demo", "forest", "--speed", "3"), ("live", "--pcap-replay", RECORDING)],
    ids=lambda command: command[0],
)
def test_what_is_shown_reaches_other_programs_without_a_page(graph: Graph, command: tuple[str, ...]):
    found = listen(graph)

    def common() -> list[int]:
        return sorted(set.intersection(*(set(messages) for messages in found.values())))

    program = [sys.executable, "-m", "aero_viz", *command, "--ros-out", "--port", "0"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        wait_until(lambda: len(common()) > 3 or process.poll() is not None, timeout=180.0)
        interrupt(process)
    stamp = common()[-1]
    odometry, best, candidates, cells, filtered, velocity, acceleration, diagnostics = (
        found[name][stamp] for name in KINDS
    )
    place, q = np.array(xyz(odometry.pose.pose.position)), odometry.pose.pose.orientation
    path = np.array([xyz(pose.pose.position) for pose in best.poses])
    assert {best.header.frame_id, filtered.header.frame_id, velocity.header.frame_id} == {"world"}
    assert cells.header.frame_id == odometry.child_frame_id == "body"
    np.testing.assert_allclose(path[0], place, atol=0.2)  # a plan begins where the drone takes itself to be
    # The chosen one is the widest of the candidates.
    chosen = max(candidates.markers, key=lambda marker: (len(marker.points) > 0, marker.scale.x))
    np.testing.assert_allclose([xyz(point) for point in chosen.points], path, atol=1e-5)
    (status,) = diagnostics.status
    values = {value.key: value.value for value in status.values}
    linear = np.array(xyz(odometry.twist.twist.linear))
    assert (status.level == DiagnosticStatus.OK) == (status.message == "safe")
    assert command[0] == "live" or status.message == "safe"  # a slow machine plans when the recording is over
    assert float(values["speed [m/s]"]) == pytest.approx(np.linalg.norm(linear), abs=1e-3)
    # The velocity is that at the second point of the path.
    np.testing.assert_allclose(xyz(velocity.twist.linear), (path[2] - path[0]) / (2.0 * STEP), atol=0.5)
    assert np.isfinite(xyz(acceleration.accel.linear)).all()
    # The cells of the body and the points of the world are the same.
    in_world = points_of(cells) @ rotation_matrix([q.w, q.x, q.y, q.z]).T + place
    assert len(in_world) > 100
    assert np.median(np.linalg.norm(in_world - points_of(filtered), axis=1)) < 0.3
    if command[0] != "demo":
        with open_recording(RECORDING) as recording:
            assert recording.poses is not None
            known = recording.poses.positions + recording.poses.offset
        assert np.linalg.norm(known - place, axis=1).min() < 0.3  # a slow machine predicts beyond the last one
