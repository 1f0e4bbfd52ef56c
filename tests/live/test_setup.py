"""What is assumed about a stream, and said."""

from __future__ import annotations

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.stream import Stream
from tests.live.conftest import Corridor, walls


def test_topics_frames_and_times_are_found_and_said(corridor: Corridor):
    setup = find_setup(corridor.stream, Wanted())
    assert (setup.points, setup.poses, setup.body, setup.world) == ("/points", "/odometry", "body", "world")
    assert setup.stamped and not setup.in_world and setup.twist == "body"
    said = "\n".join(setup.assumptions)
    assert "clouds from /points in the frame 'body', which moves with the body" in said
    assert "poses from /odometry: 'body' in 'world'" in said and "velocities are those of the messages" in said
    assert setup.measured.sweep_rate == pytest.approx(10.0) and setup.measured.pose_rate == pytest.approx(50.0)


def test_the_clouds_of_the_world_stay_where_they_are(corridor: Corridor):
    assert find_setup(corridor.stream, Wanted(frame="world")).in_world


def test_faults_are_those_of_inspect(corridor: Corridor):
    # A bracket that the sensor sees moves with the body.
    for _ in range(60):
        seen = walls(300) - corridor.place(corridor.now).astype(np.float32)
        bracket = np.full((50, 3), (0.3, 0.1, -0.1), np.float32)
        corridor.pose()
        corridor.cloud(np.concatenate([seen, bracket]))
        corridor.now += 100_000_000
    found = {finding.code for finding in find_setup(corridor.stream, Wanted(), faults=True).findings}
    assert "airframe" in found


def test_without_clouds_the_error_says_what_there_is():
    stream = Stream("empty")
    corridor = Corridor(stream, stream.clock.now())
    corridor.pose()
    with pytest.raises(UserError, match=r"empty has no PointCloud2 topic .*/odometry \(nav_msgs/msg/Odometry\)"):
        find_setup(stream, Wanted())


def test_a_named_topic_must_exist(corridor: Corridor):
    with pytest.raises(UserError, match=r"no points topic /pointz; did you mean /points\?"):
        find_setup(corridor.stream, Wanted(points="/pointz"))
