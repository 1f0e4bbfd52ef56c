"""Estimated motion of simulated flights against the true poses."""

from pathlib import Path

import bags
import numpy as np
import pytest
from command_line import run, run_json, run_refused
from rosbags.typesys import Stores, get_typestore

from aero_planner import PlannerConfig
from aero_viz.flight import FlightRules
from aero_viz.logs.sensor_log import SensorLogOptions, write_sensor_log
from aero_viz.recordings import NO_POSES, Recording, open_recording
from aero_viz.recordings.convert import convert
from aero_viz.scenes import scene

pytest.importorskip("rko_lio", reason="the extra 'odometry' is not installed")

get_typestore(Stores.ROS2_HUMBLE)  # the first use of the types takes longer than a short flight


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds in a forest, with IMU and true poses."""
    path = tmp_path_factory.mktemp("flight") / "flight.mcap"
    options = SensorLogOptions(every=3, imu=True, plan_period=None, hover=0.5, duration=2.0)
    rules = FlightRules(period=0.005, ticks_per_plan=4)
    # Errors differ from flight to flight: with these weights the limits below are valid, whatever the presets become.
    weights = {
        "sampling.dt": 0.05, "sampling.temperature": 0.1, "sampling.variance_thrust": 1.0,
        "sampling.variance_rate_xy": 1.0, "costs.q_position": 3.0, "costs.q_track": 5.0, "costs.q_control": 0.5,
        "costs.q_speed": 10.0, "costs.soft_weight": 100.0, "way_out.patience": 0.3,
    }  # fmt: skip
    config = PlannerConfig.preset("px4").replace(weights)
    write_sensor_log(scene("forest", seed=6), path, seed=6, speed=3.0, config=config, rules=rules, options=options)
    return path


@pytest.fixture
def blind(flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same flight without poses, and an empty cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path = tmp_path / "blind.mcap"
    convert(flight, path, topics=("/sweep", "/imu"))
    return path


def error(estimated: Recording, flight: Path) -> float:
    """Return the root mean square distance between estimated and true positions after alignment [m]."""
    assert estimated.poses is not None
    with open_recording(flight) as true:
        assert true.poses is not None
        times = estimated.poses.times + (estimated.start - true.start) * 1e-9
        a, b = estimated.poses.positions, true.poses.track.interpolate(times)[0]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float(np.sqrt(((a @ rotation.T - b) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("method", ["rko-lio", "kiss-icp"])
def test_the_estimate_follows_the_true_motion_and_is_cached(blind: Path, flight: Path, method: str):
    done: list[int] = []
    limit = 0.05 if method == "rko-lio" else 0.1  # without an IMU, the motion during a sweep is not corrected
    with open_recording(blind, odometry=method, progress=lambda i, _: done.append(i)) as recording:  # type: ignore[arg-type]
        assert recording.pose_topic == f"odometry by {method}"
        assert error(recording, flight) < limit
        assert not [problem for problem in recording.problems if "probably" in problem]
    assert done == list(range(1, 21))
    with open_recording(blind, odometry=method, progress=lambda i, _: done.append(i)) as again:  # type: ignore[arg-type]
        assert error(again, flight) < limit
    assert len(done) == 20


def test_auto_takes_the_imu_where_there_is_one_and_recorded_poses_first(blind: Path, flight: Path, tmp_path: Path):
    with open_recording(blind, odometry="auto") as recording:
        assert recording.pose_topic == "odometry by rko-lio"
    with open_recording(flight, odometry="auto") as recording:
        assert recording.pose_topic == "/odometry"
    bare = tmp_path / "bare.mcap"
    convert(blind, bare, topics=("/sweep",))
    with open_recording(bare, odometry="auto") as recording:
        assert recording.pose_topic == "odometry by kiss-icp"
        assert any("level at the start" in problem for problem in recording.problems)


def test_a_damaged_cache_is_replaced(blind: Path, tmp_path: Path):
    with open_recording(blind, odometry="auto"):
        pass
    (kept,) = (tmp_path / "cache").rglob("*.npz")
    kept.write_bytes(b"damaged")
    with open_recording(blind, odometry="auto") as recording:
        assert recording.poses is not None
    assert kept.stat().st_size > 100


def test_the_estimate_is_exported_with_the_sweeps(
    blind: Path, flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    target = tmp_path / "posed.mcap"
    report = run_json(capsys, "convert", str(blind), str(target), "--odometry", "auto")
    assert report["topics"]["/odometry"] == 20
    with open_recording(target) as recording:
        assert recording.pose_topic == "/odometry" and error(recording, flight) < 0.1


def test_without_poses_the_notice_names_the_option(blind: Path, capsys: pytest.CaptureFixture[str]):
    assert "--odometry auto" in NO_POSES
    code, text, _ = run(capsys, "inspect", str(blind))
    assert code == 0 and "--odometry auto" in text


def test_rko_lio_without_an_imu_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = bags.write_mcap(tmp_path / "a.mcap", [bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(3)])
    arguments = ("convert", str(path), str(tmp_path / "b.mcap"), "--odometry", "rko-lio")
    assert "needs an IMU" in run_refused(capsys, *arguments)


def test_a_sensor_that_is_moved_at_once_is_reported_as_failure(
    tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with open_recording(flight) as recording:
        items = []
        for k in range(16):
            points = recording.sweep(k).points
            if k >= 8:  # another place: mirrored, turned and far away
                points = points[:, [1, 0, 2]] * [1.0, 1.0, -0.5] + [9.0 * (k % 2), -7.0, 3.0]
            items.append(bags.cloud(0.1 * k, bags.xyz(points)))
    with open_recording(bags.write_mcap(tmp_path / "a.mcap", items), odometry="kiss-icp") as recording:
        assert any("has probably failed" in text or "has probably drifted" in text for text in recording.problems)


@pytest.mark.parametrize("name", ["{}.npy", "velodyne/{:06d}.npy"])
def test_the_motion_of_a_folder_of_clouds_is_estimated_and_kept(tmp_path, monkeypatch, name):
    pytest.importorskip("kiss_icp", reason="the extra 'odometry' is not installed")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "clouds"
    (folder / name).parent.mkdir(parents=True)
    random = np.random.default_rng(0)
    points = random.uniform([-12, -8, -1.5], [12, 8, 4], (4000, 3))
    walls = random.integers(0, 3, len(points))
    points[walls == 0, 0], points[walls == 1, 1], points[walls == 2, 2] = 12, -8, -1.5
    for k in range(5):
        np.save(folder / name.format(k), points - [0.1 * k, 0, 0])
    for _ in range(2):
        with open_recording(folder, odometry="auto") as recording:
            assert recording.poses is not None and recording.pose_origin == "odometry"
            assert abs(recording.poses.interpolate(0.4).position[0] - 0.4) < 0.1
    assert len(list((tmp_path / "cache" / "aero-viz" / "odometry").iterdir())) == 1
    np.save(folder / name.format(4), points - [0.5, 0, 0])
    with open_recording(folder, odometry="auto"):
        assert len(list((tmp_path / "cache" / "aero-viz" / "odometry").iterdir())) == 2
