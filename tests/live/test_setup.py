"""What is assumed about a stream, and said."""

from __future__ import annotations

import time

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.live.assembly import Assembler
from aero_viz.live.inspector import Inspector
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.stream import Stream
from tests.live.conftest import Corridor, Open, walls


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
        seen = corridor.seen(walls(300))
        bracket = np.full((50, 3), (0.3, 0.1, -0.1), np.float32)
        corridor.pose()
        corridor.cloud(np.concatenate([seen, bracket]))
        corridor.now += 100_000_000
    found = {finding.code for finding in find_setup(corridor.stream, Wanted(), faults=True).findings}
    assert "airframe" in found


@pytest.mark.parametrize("turns", [True, False])
def test_a_map_that_turns_with_the_drone_is_noticed(turns: bool):
    # FAST-LIO2 publishes a cloud in each frame: here, that of the body may say that it is in the world.
    stream = Stream("turning")
    corridor, points = Corridor(stream, 10**15, start=10**15), walls(4000)
    for step in range(40):
        corridor.yaw = 0.04 * step
        corridor.pose()
        corridor.cloud(corridor.seen(points) if turns else points, frame="world")
        corridor.now += 100_000_000
    setup = find_setup(stream, Wanted(), faults=True)
    assert setup.in_world and ("body-frame" in {finding.code for finding in setup.findings}) == turns


def test_velocities_of_the_world_are_noticed():
    stream = Stream("turned")
    corridor = Corridor(stream, 0, yaw=1.2, twist_in_world=True)
    corridor.fly(2.0)
    setup = find_setup(stream, Wanted())
    assert setup.twist == "world" and "in the frame of the world" in "\n".join(setup.assumptions)
    assembler = Assembler(stream, setup)
    for message in stream.messages():
        assembler.add(message)
    inputs = assembler.inputs(corridor.now)
    np.testing.assert_allclose(np.asarray(inputs.state.velocity), [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(inputs.sweeps.newest, walls(), atol=2e-3)


def test_poses_of_tf_move_the_cloud():
    stream = Stream("tf")
    corridor = Corridor(stream, 1_700_000_000_000_000_000, start=1_700_000_000_000_000_000, yaw=0.5, tf=True)
    corridor.fly(2.0)
    setup = find_setup(stream, Wanted())
    assert (setup.poses, setup.edges, setup.twist) == ("/tf", (("world", "body"),), "none")
    assembler = Assembler(stream, setup)
    for message in stream.messages():
        assembler.add(message)
    inputs = assembler.inputs(corridor.now)
    np.testing.assert_allclose(np.asarray(inputs.state.velocity), [1.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(inputs.sweeps.newest, walls(), atol=2e-3)


def test_the_findings_of_a_stream_are_told(corridor: Corridor, open_session: Open):
    session = open_session()
    told: list[str] = []
    session.subscribe_notices(lambda notice: told.append(notice.text))
    for step in range(60):  # a sensor that loses every third sweep
        corridor.pose()
        if step % 3:
            corridor.cloud(corridor.seen(walls(200)))
        corridor.now += 100_000_000
    inspector = Inspector(session, Wanted(), first=1e6)
    found = inspector.look()
    inspector.close()
    assert "dropped-sweeps" in {finding.code for finding in found.findings}
    assert session.stream_source.setup.findings == found.findings
    deadline = time.monotonic() + 10.0
    while not any("sweeps are missing" in text for text in told) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert any("sweeps are missing" in text for text in told)


def test_without_clouds_the_error_says_what_there_is():
    stream = Stream("empty")
    corridor = Corridor(stream, stream.clock.now())
    corridor.pose()
    with pytest.raises(UserError, match=r"empty has no PointCloud2 topic .*/odometry \(nav_msgs/msg/Odometry\)"):
        find_setup(stream, Wanted())


def test_a_named_topic_must_exist(corridor: Corridor):
    with pytest.raises(UserError, match=r"no points topic /pointz; did you mean /points\?"):
        find_setup(corridor.stream, Wanted(points="/pointz"))
