"""Poses in known maps, and checks of given poses, against the true motion of simulated and real sensors."""

from collections.abc import Callable
from pathlib import Path

import bags
import numpy as np
import pytest
from command_line import run, run_json, run_refused

from aero_planner import PlannerConfig
from aero_planner.quaternions import multiply, quaternion_from_angles
from aero_viz.evaluation.world_export import export_world
from aero_viz.flight import FlightRules
from aero_viz.logs.sensor_log import SensorLogOptions, write_sensor_log
from aero_viz.recordings import Recording, RecordingSource, open_recording
from aero_viz.recordings.alignment import place
from aero_viz.recordings.convert import convert
from aero_viz.recordings.registration import Surface
from aero_viz.scenes import scene

_BLIND = 0.1
"""Largest error without poses [m]: the motion within slices of 50 ms is not corrected while the drone accelerates."""


@pytest.fixture(autouse=True)
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Two seconds in a world: with true poses, without poses, and a cloud of the world."""
    folder, seed = tmp_path_factory.mktemp("flown"), 40427
    flight, blind, cloud = folder / "flight.mcap", folder / "blind.mcap", folder / "world.pcd"
    options = SensorLogOptions(every=3, plan_period=None, hover=0.3, duration=2.0)
    rules = FlightRules(period=0.01, ticks_per_plan=2)
    world = scene("mixture", seed=seed)
    write_sensor_log(world, flight, seed=seed, speed=2.0, config=PlannerConfig(), rules=rules, options=options)
    convert(flight, blind, topics=("/sweep",))
    export_world(world, cloud, spacing=0.15)
    return flight, blind, cloud


def start_of(flight: Path, *, off: tuple[float, float, float] = (0.0, 0.0, 0.0), turned: float = 0.0) -> list[float]:
    """Return where the body starts, as --map-start takes it, with an error [m] and a wrong heading [deg]."""
    with open_recording(flight) as recording:
        assert recording.poses is not None
        position = recording.poses.interpolate(0.0).position + recording.poses.offset
    return [*(position + off).tolist(), 0.0, 0.0, turned]


def error(found: Recording, flight: Path) -> float:
    """Return the root mean square distance of the found positions from the true ones, in the map [m]."""
    assert found.poses is not None
    with open_recording(flight) as true:
        assert true.poses is not None
        times = found.poses.times + (found.start - true.start) * 1e-9
        difference = found.poses.positions + found.poses.offset - true.poses.track.interpolate(times)[0]
        return float(np.sqrt(((difference - true.poses.offset) ** 2).sum(axis=1).mean()))


def test_sweeps_without_poses_are_located_in_the_map(flown: tuple[Path, Path, Path]):
    flight, blind, cloud = flown
    start, done = start_of(flight, off=(0.6, -0.5, 0.2), turned=10.0), []
    for _ in range(2):
        with open_recording(blind, map=cloud, map_start=start, progress=lambda i, _: done.append(i)) as found:
            assert error(found, flight) < _BLIND
            assert found.pose_topic == "poses in world.pcd" and len(found.sweep_times) == 20
            assert any("fit 9" in text or "fit 100" in text for text in found.problems)
            assert len(RecordingSource(found).observe().points)
    assert done[-1] == 20 and len(done) == 20  # the second time it is taken from the cache


def test_recorded_poses_lead_from_sweep_to_sweep_and_correct_their_motion(flown: tuple[Path, Path, Path]):
    flight, _, cloud = flown
    with open_recording(flight, map=cloud) as found:  # the recorded start is that in the map
        assert found.pose_topic == "poses in world.pcd" and error(found, flight) < 0.04


def test_a_map_far_from_the_origin_gives_the_same_poses(flown: tuple[Path, Path, Path], tmp_path: Path):
    from aero_viz.scenes.map_files import read_points

    flight, blind, cloud = flown
    far = np.array([512_000.0, 5_403_000.0, 420.0])
    np.save(tmp_path / "far.npy", read_points(cloud) + far)
    start = start_of(flight, off=tuple(far))
    with open_recording(blind, map=tmp_path / "far.npy", map_start=start) as found:
        assert found.poses is not None
        found.poses.offset = found.poses.offset - far
        assert error(found, flight) < _BLIND


def test_located_poses_are_exported(flown: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    flight, blind, cloud = flown
    target, start = tmp_path / "posed.mcap", map(str, start_of(flight))
    run_json(capsys, "convert", str(blind), str(target), "--map", str(cloud), "--map-start", *start)
    with open_recording(target) as found:
        assert found.pose_topic == "/odometry" and error(found, flight) < _BLIND


def rewritten(blind: Path, target: Path, change: Callable[[int, np.ndarray], np.ndarray]) -> Path:
    """Write the sweeps of a recording with other points."""
    with open_recording(blind) as recording:
        sweeps = [recording.sweep(i) for i in range(len(recording.sweep_times))]
        start = 1e-9 * (recording.start - bags.START)
    items = [bags.cloud(start + s.time, bags.xyz(change(i, s.points))) for i, s in enumerate(sweeps)]
    return bags.write_mcap(target, items)


def test_lost_sweeps_are_named_with_their_time_and_the_others_have_their_pose(
    flown: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    flight, blind, cloud = flown
    fog = np.random.default_rng(3).uniform(-6.0, 6.0, (3000, 3))
    path = rewritten(blind, tmp_path / "a.mcap", lambda i, points: fog if 9 <= i <= 12 or i == 17 else points)
    with open_recording(path, map=cloud, map_start=start_of(flight)) as found:
        told = "\n".join(found.problems)
        assert "sweeps 9 to 12, from 0.9 to 1.2 s: it fits only to" in told and "sweep 17 at 1.7 s" in told
        assert found.poses is not None and 12 <= len(found.poses.times) <= 15
        assert error(found, flight) < 0.25  # without times of the points, sweeps are not corrected
    start = list(map(str, start_of(flight)))
    report = run_json(capsys, "inspect", str(path), "--map", str(cloud), "--map-start", *start)
    assert any("sweeps 9 to 12" in text for text in report["problems"])


@pytest.mark.parametrize(("off", "turned"), [((14.0, 9.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 90.0)])
def test_a_wrong_start_is_refused(
    flown: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str], off: tuple[float, float, float], turned: float
):
    flight, blind, cloud = flown
    start = map(str, start_of(flight, off=off, turned=turned))
    told = run_refused(capsys, "inspect", str(blind), "--map", str(cloud), "--map-start", *start)
    assert "is not found in the map: at 0." in told and "Give --map-start" in told


def test_a_start_without_a_map_is_refused(flown: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str]):
    told = run_refused(capsys, "inspect", str(flown[1]), "--map-start", *["0"] * 6)
    assert "--map" in told


def tunnel(random: np.random.Generator) -> np.ndarray:
    angle = random.uniform(0.0, 2.0 * np.pi, 40_000)
    return np.stack([random.uniform(-50.0, 50.0, 40_000), 3.0 * np.cos(angle), 3.0 * np.sin(angle)], axis=1)


def field(random: np.random.Generator) -> np.ndarray:
    return np.column_stack([random.uniform(-40.0, 40.0, (40_000, 2)), np.full(40_000, -1.5)])


@pytest.mark.parametrize("shape", [tunnel, field])
def test_a_place_that_leaves_a_direction_open_gives_no_pose(shape: Callable[[np.random.Generator], np.ndarray]):
    random = np.random.default_rng(8)
    points = shape(random)
    seen = points[np.linalg.norm(points, axis=1) < 20.0][::4]
    fit = Surface(points + random.normal(0.0, 0.03, points.shape)).fit(
        seen + random.normal(0.0, 0.03, seen.shape), np.eye(4)
    )
    assert fit.fitness > 0.95 and "leave a direction open" in fit.problem(least=0.75)


def posed(flight: Path, target: Path, change: Callable[[np.ndarray, np.ndarray, np.ndarray], tuple]) -> list[str]:
    """Write the true poses with an error as TUM text, and return the flags that play with them."""
    with open_recording(flight) as recording:
        poses = recording.poses
        assert poses is not None
        p, q = change(poses.times, poses.positions.copy(), poses.quaternions.copy())
        stamps = poses.times + 1e-9 * recording.start
    rows = np.column_stack([stamps, p, q[:, 1:], q[:, :1]])
    np.savetxt(target, rows, fmt="%.9f")
    return ["--poses", str(target), "--check-poses"]


def as_they_are(times: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return p, q


def too_long(times: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 1.15 * p, q


def turning(times: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return p, np.array(
        [multiply(quaternion_from_angles(0.0, 0.0, 4.0 * t), one) for t, one in zip(times, q, strict=True)]
    )


def jumping(times: np.ndarray, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return p + np.outer((times > 1.25) & (times < 1.45), [0.0, 0.6, 0.0]), q


@pytest.mark.parametrize(
    ("change", "with_map"),
    [*((change, False) for change in (as_they_are, too_long, turning, jumping)), (as_they_are, True), (jumping, True)],
)
def test_given_poses_are_checked(
    flown: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], change, with_map: bool
):
    flight, blind, cloud = flown
    flags = posed(flight, tmp_path / "poses.txt", change)
    if with_map:
        flags += ["--map", str(cloud), "--map-start", *map(str, start_of(flight))]
    report = run_json(capsys, "inspect", str(blind), *flags)
    check, faults = report["pose_check"], [f for f in report["findings"] if f["code"] == "pose-drift"]
    assert check["checked"] >= 18 and check["fitness"] > 0.7
    assert check["reference"].startswith("the map" if with_map else "the registration")
    assert bool(faults) is (change is not as_they_are)
    if change is too_long:
        assert check["drift_m"] / check["way_m"] == pytest.approx(0.15 / 1.15, abs=0.05)
    if change is turning:
        assert check["drift_deg"] == pytest.approx(4.0 * 1.9, abs=1.5)
    if change is jumping:
        assert 1.2 < check["step_at_s"] < 1.65 and check["step_m"] == pytest.approx(0.6, abs=0.15)


def test_the_check_is_told_in_words(flown: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "inspect", str(flown[1]), *posed(flown[0], tmp_path / "poses.txt", jumping))
    assert code == 0 and "poses checked by the registration" in text and "FAULT (pose-drift)" in text


def test_sparse_sweeps_say_nothing_of_the_poses(capsys: pytest.CaptureFixture[str]):
    from aero_viz.catalog import shipped_recordings

    sparse = str(shipped_recordings()["forest_mid360"][0])
    code, text, _ = run(capsys, "inspect", sparse, "--check-poses")
    assert code == 0 and "too few to tell" in text and "pose-drift" not in text


def test_without_poses_there_is_nothing_to_check(flown: tuple[Path, Path, Path], capsys: pytest.CaptureFixture[str]):
    assert "no poses to check" in run_refused(capsys, "inspect", str(flown[1]), "--check-poses")


def test_a_real_sensor_is_located_in_the_map_of_its_other_sweeps(shared_datasets: Path, tmp_path: Path):
    with open_recording(shared_datasets / "hilti_os0_A_mcap") as true:
        assert true.poses is not None
        cloud = np.concatenate([place(true.sweep(i), true.poses) for i in range(0, 24, 2)])
        np.save(tmp_path / "map.npy", cloud)
        items = [bags.cloud(1.0 + true.sweep(i).time, bags.xyz(true.sweep(i).points)) for i in range(1, 24, 2)]
        path = bags.write_mcap(tmp_path / "odd.mcap", items)
        first = true.poses.interpolate(true.sweep_times[1])
        positions = true.poses.interpolate(true.sweep_times[1::2]).position
    start = [*np.add(first.position, [0.4, -0.3, 0.1]), *_angles(first.quaternion)]
    with open_recording(path, map=tmp_path / "map.npy", map_start=start) as found:
        assert found.poses is not None and len(found.poses.times) == 12
        found_at = found.poses.positions + found.poses.offset
    assert np.linalg.norm(found_at - positions, axis=1).max() < 0.05


@pytest.mark.parametrize("name", ["hilti_os0_A_mcap", "ouster_os1_128_mcap"])
def test_the_poses_of_real_recordings_agree_with_their_sweeps(
    shared_datasets: Path, capsys: pytest.CaptureFixture[str], name: str
):
    report = run_json(capsys, "inspect", str(shared_datasets / name), "--check-poses")
    assert report["pose_check"]["fitness"] > 0.9 and report["pose_check"]["drift_m"] < 0.1
    assert not [finding for finding in report["findings"] if finding["code"] == "pose-drift"]


def _angles(q: np.ndarray) -> list[float]:
    """Return roll, pitch and yaw [deg] of a quaternion."""
    w, x, y, z = q
    roll, yaw = (
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
    return np.degrees([roll, np.arcsin(2 * (w * y - z * x)), yaw]).tolist()
