import json
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from aero_planner import PlannerConfig, Sweeps
from aero_planner.config.file import load_config
from aero_viz.errors import UserError
from aero_viz.flight import FlightResult, FlightSource, fly
from aero_viz.logs import FlightLog, flight_log, flight_recorder, record
from aero_viz.logs.flight_messages import new_sweeps
from aero_viz.recordings import RecordingSource, inspect, open_recording
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel
from aero_viz.session import Session

LIDAR = LidarModel("small", points_per_sweep=1000)
CONFIG = PlannerConfig().replace({"sampling.samples": 8})


@pytest.fixture
def session():
    source = FlightSource(scene("forest", seed=2, count=40), lidar=LIDAR, seed=4)
    session = Session(source, config=CONFIG, seed=4)
    yield session
    session.close()


def write(path, frames) -> None:
    log = FlightLog(path)
    for frame in frames:
        log.write(frame)
    log.close()


def decoded(path):
    """Return the messages by topic, decoded by a ROS 2 reader with the embedded definitions."""
    messages = {}
    with Path(path).open("rb") as file:
        for _, channel, message, ros in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, ros))
    return messages


def wait_for(condition, timeout: float = 60.0) -> bool:
    deadline = time.monotonic() + timeout
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    return bool(condition())


def attachments(path):
    with Path(path).open("rb") as file:
        return {item.name: item.data.decode() for item in make_reader(file).iter_attachments()}


def metadata(path):
    with Path(path).open("rb") as file:
        return {item.name: dict(item.metadata) for item in make_reader(file).iter_metadata()}


def test_messages_hold_the_content_of_the_frames(session, tmp_path):
    frames = [session.tick() for _ in range(12)]
    write(tmp_path / "a.mcap", frames)
    topics = decoded(tmp_path / "a.mcap")
    assert {name: len(messages) for name, messages in topics.items()} == {
        "/odometry": 12, "/tf": 12, "/sweep": 32, "/plan": 12, "/plan/best": 12, "/plan/guides": 12,
        "/plan/rollouts": 12, "/goal": 1,
    }  # fmt: skip
    frame, plan = frames[7], frames[7].plan
    stamp, odometry = topics["/odometry"][7]
    assert stamp - topics["/odometry"][0][0] == 140_000_000
    assert odometry.header.stamp.sec * 10**9 + odometry.header.stamp.nanosec == stamp
    p = odometry.pose.pose.position
    assert [p.x, p.y, p.z] == pytest.approx(np.asarray(frame.observation.state.position).tolist())
    (_, transforms) = topics["/tf"][7]
    assert transforms.transforms[0].child_frame_id == odometry.child_frame_id == "body"

    _, costs = topics["/plan"][7]
    assert (costs.best, costs.status, tuple(costs.kinds)) == (plan.best, plan.status, plan.kinds)
    np.testing.assert_array_equal(costs.stage2_cost, plan.stage2_cost)
    np.testing.assert_array_equal(costs.clearance, plan.clearance.min(axis=1))
    np.testing.assert_array_equal(costs.command, plan.controls[plan.best, 0])
    _, path = topics["/plan/best"][7]
    flown = [[s.pose.position.x, s.pose.position.y, s.pose.position.z] for s in path.poses]
    np.testing.assert_array_equal(np.array(flown, np.float32), plan.positions[plan.best])
    for topic, lines in (("/plan/guides", plan.guides), ("/plan/rollouts", plan.positions)):
        _, markers = topics[topic][7]
        drawn = [[[point.x, point.y, point.z] for point in marker.points] for marker in markers.markers]
        np.testing.assert_array_equal(np.array(drawn, np.float32), lines)
        assert [marker.id for marker in markers.markers] == list(range(len(plan.kinds)))


def test_each_sweep_is_written_once_in_the_body_frame(session, tmp_path):
    frames = [session.tick() for _ in range(12)]  # new sweeps at ticks 5 and 10
    write(tmp_path / "a.mcap", frames)
    sweeps = decoded(tmp_path / "a.mcap")["/sweep"]
    assert len(sweeps) == 32  # thirty at the start, two new
    sizes = [cloud.width for _, cloud in sweeps]
    assert sum(sizes[:30]) == frames[0].observation.sweeps.point_count
    for index, sweep in ((5, sweeps[30]), (10, sweeps[31])):
        _, cloud = sweep
        assert cloud.header.frame_id == "body"
        points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
        assert 100 < len(points) <= 1000
        # The nearest return is as far from the drone as it was.
        new = frames[index].observation.points[-len(points) :]
        state = frames[index].observation.state
        expected = np.linalg.norm(new - np.asarray(state.position), axis=1)
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), expected, atol=1e-4)


def test_new_sweeps_are_those_that_joined_at_the_end():
    rng = np.random.default_rng(0)
    a, b, c, d = Sweeps([rng.normal(size=(n, 3)).astype(np.float32) for n in (5, 3, 4, 6)])
    copy = b.copy()  # a live drone sends its sweeps again
    cases = [
        ([a, b, c], [b, c, d], [d]),
        ([a, b, c], [copy, c, d], [d]),
        ([a, b, c], [a, b, c], []),
        ([a], [a, b], [b]),  # none has left yet
        ([a, b, c], [c, d], [d]),  # two have
        ([a, b, b], [b, b, c], [c]),
        ([a], [b, c], [b, c]),  # a jump
        (None, [a, b], [a, b]),
    ]
    for before, after, expected in cases:
        added = new_sweeps(None if before is None else Sweeps(before), Sweeps(after))
        assert len(added) == len(expected)
        for points, wanted in zip(added, expected, strict=True):
            np.testing.assert_array_equal(points, wanted)


def test_configurations_world_and_settings_are_attached(session, tmp_path):
    world = session.source.world
    first = session.tick()
    session.configure({"costs.q_track": 7.5})
    frames = [first, session.tick(), session.tick()]
    write(tmp_path / "a.mcap", frames)
    files = attachments(tmp_path / "a.mcap")
    names = [f"config_{frame.config_version}.yaml" for frame in frames[:2]]
    assert set(files) == {"world.json", "flight.json", *names} and names[0] != names[1]
    assert World.from_dict(json.loads(files["world.json"])).to_dict() == world.to_dict()
    for name, config in zip(names, (frames[0].config, frames[1].config), strict=True):
        (tmp_path / name).write_text(files[name], encoding="utf-8")
        assert load_config(tmp_path / name) == config
    assert metadata(tmp_path / "a.mcap")["flight_log"] == {"frames": "3", "dropped": "0"}


def test_changes_from_the_page_are_logged(session, tmp_path):
    """Another goal, a goal that is undone by going back in time, another world, and a recording as the source."""
    worlds = [session.source.world, scene("wall", seed=1)]
    path = tmp_path / "a.mcap"
    with record(session, path):
        frames = [session.tick() for _ in range(3)]
        session.set_goal([30.0, 4.0, 2.5]).result()
        frames += [session.frame, session.tick()]
        session.step(-2)
        frames.append(session.frame)
        session.set_source(FlightSource(worlds[1], lidar=LIDAR, seed=9)).result()
        frames += [session.frame, session.tick()]
    topics = decoded(path)
    assert [len(topics[topic]) for topic in ("/plan", "/goal")] == [8, 4]
    goals = [(message.pose.position, message.header) for _, message in topics["/goal"]]
    expected = [frames[i].observation.goal.position for i in (0, 3, 5, 6)]
    np.testing.assert_array_equal([[p.x, p.y, p.z] for p, _ in goals], expected)
    assert {header.frame_id for _, header in goals} == {"world"}
    np.testing.assert_array_equal(expected[3], worlds[1].goal)
    assert topics["/goal"][1][0] == topics["/plan"][3][0]

    with path.open("rb") as file:
        attached = {item.name: item for item in make_reader(file).iter_attachments()}
    assert set(attached) == {"world.json", "flight.json", "world_1.json", "flight_1.json", "config_0.yaml"}
    for suffix, world, seed, plan in (("", worlds[0], 4, 0), ("_1", worlds[1], 9, 6)):
        item, settings = attached[f"world{suffix}.json"], json.loads(attached[f"flight{suffix}.json"].data)
        assert World.from_dict(json.loads(item.data)).to_dict() == world.to_dict()
        assert (settings["source"], settings["seed"]) == (world.name, seed)
        assert item.log_time == topics["/plan"][plan][0]

    with record(session, tmp_path / "b.mcap"):
        session.set_source(RecordingSource(open_recording(path))).result()
    files = attachments(tmp_path / "b.mcap")
    assert set(files) == {"world.json", "flight.json", "flight_1.json", "config_0.yaml"}
    assert json.loads(files["flight_1.json"]) == {"source": session.source.name}
    assert inspect(path).pose_topic == "/odometry"


class Logged(NamedTuple):
    """A whole flight: where it was logged, and its result."""

    log: Path
    trajectory: Path
    result: FlightResult


OPTIONS: dict[str, Any] = {"config": CONFIG, "seed": 4, "lidar": LIDAR, "speed": 4.0}


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> Logged:
    """A flight to the goal behind a wall."""
    log, trajectory = (tmp_path_factory.mktemp("flight") / name for name in ("a.mcap", "a.csv"))
    world = scene("wall", seed=1)
    return Logged(log, trajectory, fly(world, recorder=flight_recorder(log), trajectory=trajectory, **OPTIONS))


def test_play_sees_the_flight_that_was_logged(logged: Logged):
    world, result = scene("wall", seed=1), logged.result
    info = inspect(logged.log)
    ticks = round(result.flight_time_s / 0.02)
    assert (info.sweeps, info.poses, info.points_topic) == (30 + ticks // 5, ticks + 1, "/sweep")
    assert info.problems == ()
    with open_recording(logged.log) as recording:
        assert recording.poses is not None and recording.poses.measured_velocity
        source = RecordingSource(recording)
        source.seek(1.0)
        seen = source.observe()
        assert np.abs(world.distance(seen.points + recording.poses.offset)).max() < 0.15  # 6 sigma of the range noise
        with closing(Session(source, config=CONFIG)) as session:
            assert len(session.tick().plan.kinds) == len(CONFIG.kinds)


def test_the_cloud_at_the_start_of_a_short_log_does_not_count_as_sweeps_at_a_high_rate(session, tmp_path):
    write(tmp_path / "a.mcap", [session.tick() for _ in range(60)])
    info = inspect(tmp_path / "a.mcap")
    assert info.measured is not None and info.measured.sweep_rate == pytest.approx(10.0, rel=0.01)
    assert "dropped-sweeps" not in [finding.code for finding in info.findings]


def test_logging_does_not_change_the_flight(logged: Logged, tmp_path: Path):
    plain = fly(scene("wall", seed=1), trajectory=tmp_path / "b.csv", **OPTIONS)
    assert (logged.result.reason, logged.result.smoothness) == (plain.reason, plain.smoothness)
    assert logged.trajectory.read_text() == (tmp_path / "b.csv").read_text()


def test_stamps_increase_when_the_session_goes_back(session, tmp_path):
    frames = [session.tick() for _ in range(8)]
    session.step(-5)
    frames += [session.frame, session.tick()]
    write(tmp_path / "a.mcap", frames)
    stamps = [stamp for stamp, _ in decoded(tmp_path / "a.mcap")["/odometry"]]
    assert np.diff(stamps).tolist() == [20_000_000] * 9
    replanned = session.configure({"costs.q_track": 9.0}) and session.frame
    write(tmp_path / "b.mcap", [frames[-1], replanned])
    counts = Counter({name: len(messages) for name, messages in decoded(tmp_path / "b.mcap").items()})
    assert (counts["/plan"], counts["/odometry"]) == (2, 1)  # planned twice from the same state


def test_a_running_session_is_recorded_and_drops_are_counted(session, tmp_path, monkeypatch):
    with record(session, tmp_path / "a.mcap") as log:
        for _ in range(10):
            session.tick()
    assert log.frames == 10
    assert metadata(tmp_path / "a.mcap")["flight_log"] == {"frames": "10", "dropped": "0"}

    notices = []
    session.subscribe_notices(notices.append)
    gate = threading.Event()
    with record(session, tmp_path / "b.mcap") as log:
        write = log.write
        monkeypatch.setattr(log, "write", lambda frame: (gate.wait(), write(frame)))  # a disk that takes its time
        for step in range(280):
            session.configure({"costs.q_track": 5.0 + 0.001 * (step + 1)})  # planned and published at once
        gate.set()
    kept = metadata(tmp_path / "b.mcap")["flight_log"]
    assert int(kept["dropped"]) >= 20 and int(kept["frames"]) + int(kept["dropped"]) == 281
    assert wait_for(lambda: any("cannot keep up" in notice.text for notice in notices))


def test_frames_that_wait_too_long_at_the_end_are_counted_and_reported(session, tmp_path, monkeypatch):
    monkeypatch.setattr(flight_log, "_CLOSE_TIMEOUT", 0.1)
    notices = []
    session.subscribe_notices(notices.append)
    begun, gate, path = threading.Event(), threading.Event(), tmp_path / "a.mcap"
    with record(session, path) as log:
        write = log.write
        monkeypatch.setattr(log, "write", lambda frame: (begun.set(), gate.wait(), write(frame)))
        for _ in range(20):
            session.tick()
        assert begun.wait(60.0)
        threading.Timer(2.5, gate.set).start()  # longer than the end of a sink is waited for elsewhere
    kept = {name: int(value) for name, value in metadata(path)["flight_log"].items()}
    assert kept == {"frames": 1, "dropped": 19} and len(decoded(path)["/plan"]) == 1
    message = f"The flight log {path} lacks 19 frames: the disk was too slow for them."
    assert wait_for(lambda: any(notice.text == message for notice in notices))


def test_a_full_disk_ends_the_log_and_not_the_flight(session, tmp_path):
    resource = pytest.importorskip("resource", reason="files of limited size need POSIX")
    notices = []
    session.subscribe_notices(notices.append)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with record(session, tmp_path / "a.mcap"):
        session.tick()
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
        try:
            for _ in range(100):
                session.tick()
            assert wait_for(lambda: notices)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert session.tick().index == 101
    assert notices[0].text == f"The flight log {tmp_path / 'a.mcap'} ends here: File too large."
    assert len(notices) == 1


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(UserError, match="Cannot write the flight log"):
        FlightLog(tmp_path / "none" / "a.mcap")
    if Path("/dev/full").exists():
        with pytest.raises(UserError, match="Cannot write the flight log /dev/full: No space left on device"):
            FlightLog("/dev/full")
    with pytest.raises(UserError, match="Cannot write"):
        fly(
            scene("wall"),
            recorder=flight_recorder(tmp_path / "a.mcap"),
            lidar=LIDAR,
            trajectory=tmp_path / "none" / "a.csv",
        )


_WRITER = """
import sys
from aero_planner import PlannerConfig
from aero_viz.flight import FlightSource
from aero_viz.logs import record
from aero_viz.scenes import scene
from aero_viz.sensors import LidarModel
from aero_viz.session import Session

source = FlightSource(scene("forest", seed=2, count=40), lidar=LidarModel("small", points_per_sweep=1000), seed=4)
session = Session(source, config=PlannerConfig().replace({"sampling.samples": 8}), seed=4)
with record(session, sys.argv[1]):
    session.start()
    while True:
        pass
"""


def test_killed_while_flying(tmp_path):
    path = tmp_path / "a.mcap"
    writer = subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 300.0
        while not (path.exists() and path.stat().st_size > 400_000) and time.monotonic() < deadline:
            time.sleep(0.05)
            assert writer.poll() is None
    finally:
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    info = inspect(path)
    assert any("truncated" in problem for problem in info.problems)
    assert info.sweeps >= 12 and info.poses > 20
    with open_recording(path) as recording:
        assert not recording.damaged_sweeps
        assert all(len(recording.sweep(i).points) for i in range(info.sweeps))
