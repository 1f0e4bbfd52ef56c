import errno
import os
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from aero_planner import Planner, PlannerConfig, VehicleState
from aero_planner.config.file import load_config
from aero_planner.onboard.flight_config import load_onboard
from aero_planner.onboard.flight_log import FlightLog
from aero_planner.onboard.interfaces import VehicleSample
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.conftest import Records
from tests.planner.onboard.simulated import PLACES, SMALL, Relay, Simulation, poles

WORLD = poles(PLACES)


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Return the messages by topic, decoded with the embedded definitions."""
    topics: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, message, ros in reader.iter_decoded_messages():
            topics.setdefault(channel.topic, []).append((message.log_time, ros))
    return topics


def sample(time: float) -> VehicleSample:
    state = VehicleState(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), None, time)
    return VehicleSample(time, state, True, True, time)


@pytest.fixture(scope="module")
def flown(shared_planner: Planner, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Records, Simulation]:
    """A short flight, what its observer saw, and its log."""
    path, seen = tmp_path_factory.mktemp("log") / "flight.mcap", Records()
    relay = Relay()
    shared_planner.configure(SMALL)
    simulation = Simulation(shared_planner, WORLD, (18.0, 0.0, 2.0), observers=[relay])
    log = FlightLog(path, SMALL, OnboardConfig(), clock=lambda: simulation.now)
    relay.observers = [log, seen]
    simulation.engage()
    simulation.run(1.5)
    simulation.node.close()
    assert log.dropped == 0 and not log.failed
    return path, seen, simulation


def test_the_log_holds_states_points_plans_and_transitions(flown: tuple[Path, Records, Simulation]):
    path, seen, simulation = flown
    topics = decoded(path)
    assert set(topics) == {
        "/odometry", "/tf", "/sweep", "/plan", "/plan/best", "/plan/guides", "/plan/rollouts", "/safety",
    }  # fmt: skip
    assert len(topics["/plan"]) == len(topics["/plan/best"]) == len(seen.plans) > 20
    for (_, plan), (_, route), record in zip(topics["/plan"], topics["/plan/best"], seen.plans, strict=True):
        assert (plan.best, plan.status, tuple(plan.kinds)) == (
            record.plan.best, record.plan.status, record.plan.kinds,
        )  # fmt: skip
        np.testing.assert_array_equal(plan.stage2_cost, record.plan.stage2_cost)
        np.testing.assert_array_equal(plan.command, record.plan.command[0])
        assert plan.plan_ms == pytest.approx(record.plan_ms)
        drawn = [[s.pose.position.x, s.pose.position.y, s.pose.position.z] for s in route.poses]
        np.testing.assert_array_equal(np.array(drawn, np.float32), record.plan.positions[record.plan.best])
    changes = [(change.source, change.target) for _, change in topics["/safety"]]
    assert changes == [("WAITING", "READY"), ("READY", "FLYING")]
    stamp, last = topics["/odometry"][-1]
    assert stamp == last.header.stamp.sec * 10**9 + last.header.stamp.nanosec
    p, q = last.pose.pose.position, last.pose.pose.orientation
    assert [p.x, p.y, p.z] == pytest.approx(simulation.motion.position.tolist(), abs=0.1)
    assert [q.w, q.x, q.y, q.z] == pytest.approx(simulation.motion.quaternion.tolist(), abs=0.05)
    assert last.child_frame_id == "body" and len(topics["/odometry"]) == len(topics["/tf"])


def test_guides_and_rollouts_are_logged_ten_times_per_second(flown: tuple[Path, Records, Simulation]):
    path, seen, _ = flown
    topics = decoded(path)
    stamps = [stamp for stamp, _ in topics["/plan"]]
    drawn = [stamp for stamp, _ in topics["/plan/guides"]]
    assert drawn == [stamp for stamp, _ in topics["/plan/rollouts"]] and drawn[0] == stamps[0]
    assert np.diff(drawn).min() >= 0.098e9 and np.diff(drawn).max() < 0.15e9
    for topic, lines in (("/plan/guides", "guides"), ("/plan/rollouts", "positions")):
        for stamp, message in topics[topic]:
            plan, markers = seen.plans[stamps.index(stamp)].plan, message.markers
            points = [[[point.x, point.y, point.z] for point in marker.points] for marker in markers]
            np.testing.assert_array_equal(np.array(points, np.float32), getattr(plan, lines))
            assert {marker.header.frame_id for marker in markers} == {"world"}
            assert [(marker.ns, marker.id) for marker in markers] == [
                (topic[6:], index) for index in range(len(plan.kinds))
            ]
            wide = [index for index, marker in enumerate(markers) if marker.scale.x > 0.02]
            assert wide == ([plan.best] if topic == "/plan/rollouts" else [])


def test_configurations_are_attached(flown: tuple[Path, Records, Simulation], tmp_path: Path):
    with flown[0].open("rb") as file:
        texts = {item.name: item.data.decode() for item in make_reader(file).iter_attachments()}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    assert load_config(tmp_path / "config_0.yaml") == SMALL
    assert load_onboard(tmp_path / "onboard.yaml") == OnboardConfig()


def test_a_full_disk_ends_the_log_and_not_the_flight(
    small_planner: Planner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    relay = Relay()
    simulation = Simulation(small_planner, WORLD, (18.0, 0.0, 2.0), observers=[relay])
    log = FlightLog(tmp_path / "full.mcap", SMALL, OnboardConfig(), clock=lambda: simulation.now, flush_period=0.0)
    relay.observers = [log]

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    simulation.engage()
    simulation.run(0.5)
    simulation.node.close()
    assert log.failed and simulation.node.failures == 0
    assert "full.mcap ends early: No space left on device" in caplog.text


def test_a_slow_disk_at_the_end_drops_waiting_items_and_logs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    log = FlightLog(tmp_path / "slow.mcap", SMALL, OnboardConfig(), clock=lambda: 0.0, flush_period=0.0)
    stuck, gate, sync = threading.Event(), threading.Event(), os.fsync

    def slow(file: int) -> None:
        stuck.set()
        assert gate.wait(60.0)
        sync(file)

    monkeypatch.setattr(os, "fsync", slow)
    log.observe(sample(1.0))
    assert stuck.wait(60.0)
    for k in range(30):
        log.observe(sample(2.0 + 0.02 * k))
    log.close(0.1)
    assert "slow.mcap may be missing: the disk is too slow; 30 items were dropped" in caplog.text
    log.observe(sample(3.0))  # while the thread hangs
    assert log.dropped == 31
    # When the disk recovers, the file is complete: no other thread has closed or written it.
    gate.set()
    for thread in threading.enumerate():
        if thread.name == "aero-planner-log":
            thread.join(60.0)
    assert len(decoded(log.path)["/odometry"]) == 1 and "aero-planner-log failed" not in caplog.text
    with log.path.open("rb") as file:
        assert [record.metadata for record in make_reader(file).iter_metadata()] == [{"dropped": "31"}]


def test_no_flight_replaces_another(tmp_path: Path):
    paths = []
    for k in range(3):
        log = FlightLog(tmp_path / "flight.mcap", SMALL, OnboardConfig(), clock=lambda: 0.0)
        for i in range(k + 1):
            log.observe(sample(1.0 + i))
        log.close()
        paths.append(log.path)
    assert [path.name for path in paths] == ["flight.mcap", "flight_1.mcap", "flight_2.mcap"]
    assert [len(decoded(path)["/odometry"]) for path in paths] == [1, 2, 3]


def test_a_log_that_cannot_be_written_is_an_error_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(OSError):
        FlightLog(tmp_path / "absent" / "a.mcap", PlannerConfig(), OnboardConfig())
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(ImportError, match=r"pip install mcap"):
        FlightLog(tmp_path / "a.mcap", PlannerConfig(), OnboardConfig())


@pytest.mark.parametrize("now", [-1e9, 0.0, 2.0**31 - 10.0, 2.0**31 + 1e9, 1e12])
def test_a_date_that_ros_cannot_express_costs_no_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, now: float):
    monkeypatch.setattr("time.time", lambda: now)
    log = FlightLog(tmp_path / "flight.mcap", SMALL, OnboardConfig(), clock=lambda: 0.0)
    for i in range(20):
        log.observe(sample(0.1 * i))
    log.close(60.0)
    assert not log.failed
    stamps = [time for time, _ in decoded(log.path)["/odometry"]]
    assert len(set(stamps)) == 20 and stamps[-1] - stamps[0] == pytest.approx(1.9e9, rel=1e-3)
