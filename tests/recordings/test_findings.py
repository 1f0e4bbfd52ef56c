"""The check-up on recordings that have exactly one fault, made from a simulated flight, and on good ones."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import bags
import numpy as np
import pytest
from command_line import run, run_json

from aero_planner import PlannerConfig
from aero_planner.quaternions import conjugate, quaternion_from_angles, rotate, rotation_matrix
from aero_viz.catalog import shipped_recordings
from aero_viz.logs.sensor_log import SensorLogOptions, write_sensor_log
from aero_viz.recordings import inspect, open_recording
from aero_viz.recordings.alignment import place
from aero_viz.recordings.findings import Finding
from aero_viz.recordings.misalignment import estimate_misalignment
from aero_viz.recordings.transforms import Transform
from aero_viz.scenes import scene


class Flight(NamedTuple):
    """Four seconds of a flight through the forest."""

    sweeps: list[tuple[float, np.ndarray, np.ndarray]]
    """Time [s], points [P, 3] [m], body frame, and times of the points [P] [ns]."""
    world: list[np.ndarray]
    """The points of the sweeps in the world frame."""
    times: np.ndarray
    positions: np.ndarray
    quaternions: np.ndarray
    velocities: np.ndarray


def fly(folder: Path, *, seed: int) -> Path:
    path = folder / "flight.mcap"
    config = PlannerConfig().replace({"escape.ahead": 1000.0})  # other parameters make another flight
    options = SensorLogOptions(every=4, plan_period=None, duration=4.0)
    write_sensor_log(scene("forest", seed=seed), path, config=config, seed=seed, speed=5.0, options=options)
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Flight:
    with open_recording(fly(tmp_path_factory.mktemp("flight"), seed=5)) as recording:
        poses = recording.poses
        assert poses is not None
        found = [recording.sweep(i) for i in range(len(recording.sweep_times))]
        sweeps = [(s.time, s.points, np.round(s.point_times * 1e9).astype("u4")) for s in found]  # type: ignore[operator]
        world = [place(sweep, poses) for sweep in found]
        return Flight(sweeps, world, poses.times, poses.positions, poses.quaternions, poses.velocities)


Build = Callable[..., Path]


@pytest.fixture
def build(flight: Flight, mcap_of: Callable[[list[bags.Item]], Path]) -> Build:
    """Return a function that writes the flight, with changes."""

    def write(
        *,
        sweeps: list[tuple[float, np.ndarray, np.ndarray]] | None = None,
        positions: np.ndarray | None = None,
        twists: np.ndarray | None = None,
        late: float = 0.0,
    ) -> Path:
        items: list[bags.Item] = []
        for time, points, offsets in sweeps or flight.sweeps:
            items.append(bags.cloud(time + late, {**bags.xyz(points), "t": offsets}))
        twists = rotate(conjugate(flight.quaternions), flight.velocities) if twists is None else twists
        positions = flight.positions if positions is None else positions
        for row in zip(flight.times, positions, flight.quaternions, twists, strict=True):
            items.append(bags.odometry(*row))
        return mcap_of(items)

    return write


def findings(path: Path) -> dict[str, Finding]:
    """The findings on a recording by code, in their order."""
    found = inspect(path).findings
    assert len({finding.code for finding in found}) == len(found)
    return {finding.code: finding for finding in found}


def codes(path: Path) -> list[str]:
    return list(findings(path))


def test_a_good_flight_has_no_findings(build: Build):
    report = inspect(build())
    assert report.findings == ()
    measured = report.measured
    assert measured is not None and measured.timed_points
    assert measured.sweep_rate == pytest.approx(10.0) and measured.pose_rate == pytest.approx(50.0)
    assert measured.ground_height == pytest.approx(-2.0, abs=0.1)  # below the first pose
    assert measured.elevation_deg is not None
    assert measured.elevation_deg == pytest.approx((-7.0, 52.0), abs=3.0) and measured.azimuth_deg == 360.0


def test_shipped_recordings_have_no_findings_and_only_ground_that_was_seen():
    grounds, texts = {}, {}
    for name, (path, _) in shipped_recordings().items():
        report = inspect(path)
        assert report.findings == () and report.measured is not None
        grounds[name], texts[name] = report.measured.ground_height, report.measured.format_line()
    assert grounds == {"forest_mid360": pytest.approx(0.0, abs=0.1), "room_mid360": None}, "walls are no ground"
    assert "ground at z = " in texts["forest_mid360"] and "no level ground seen" in texts["room_mid360"]


@pytest.mark.parametrize(("name", "expected"), [("ouster_os1_128_mcap", []), ("hilti_os0_A_mcap", ["twist-zero"])])
def test_real_recordings_have_no_faults(shared_datasets: Path, name: str, expected: list[str]):
    report = inspect(shared_datasets / name)
    assert [finding.code for finding in report.findings] == expected
    assert not any(finding.is_fault for finding in report.findings)


def test_a_cloud_in_the_world_frame(build: Build, flight: Flight):
    sweeps = [(time, cloud, at) for (time, _, at), cloud in zip(flight.sweeps, flight.world, strict=True)]
    assert codes(build(sweeps=sweeps)) == ["world-frame"]


def test_a_twist_that_is_zero(build: Build, flight: Flight):
    found = findings(build(twists=np.zeros_like(flight.velocities)))
    assert list(found) == ["twist-zero"]
    assert not found["twist-zero"].is_fault


def test_a_twist_in_the_world_frame(mcap_of: Callable[[list[bags.Item]], Path]):
    # A straight flight to the left while the nose points along x: body and world differ by the heading.
    turned = quaternion_from_angles(0.0, 0.0, 90.0)
    items = [bags.cloud(0.1 * k, bags.xyz(bags.wall(seed=k))) for k in range(20)]
    items += [bags.odometry(0.05 * k, (0.0, 0.1 * k, 0.0), turned, (0.0, 2.0, 0.0)) for k in range(40)]
    assert "twist-frame" in codes(mcap_of(items))
    items[20:] = [bags.odometry(0.05 * k, (0.0, 0.1 * k, 0.0), turned, (2.0, 0.0, 0.0)) for k in range(40)]
    assert "twist-frame" not in codes(mcap_of(items))


def test_a_twist_in_a_wrong_unit(build: Build, flight: Flight):
    assert codes(build(twists=3.6 * rotate(conjugate(flight.quaternions), flight.velocities))) == ["twist-wrong"]


@pytest.mark.parametrize("late", [0.05, -0.05])
def test_a_time_offset_is_measured(build: Build, late: float):
    found = findings(build(late=late))
    assert list(found) == ["time-offset"]
    text = found["time-offset"].evidence
    assert ("too late" if late > 0 else "too early") in text
    assert abs(float(text.split("stamped ")[1].split(" ms")[0]) - 50.0) < 6.0


def test_a_wrong_mounting_is_measured(build: Build, flight: Flight):
    turn = rotation_matrix(quaternion_from_angles(0.0, 5.0, 0.0))
    found = findings(build(sweeps=[(time, points @ turn.T, at) for time, points, at in flight.sweeps]))
    assert list(found) == ["extrinsic"]
    assert abs(abs(float(found["extrinsic"].evidence.split("pitch ")[1].split(",")[0])) - 5.0) < 1.0


@pytest.mark.parametrize("seed", [3, 6])  # a long way of the search, and few surfaces
def test_estimates_do_not_depend_on_the_flight(tmp_path: Path, seed: int):
    with open_recording(fly(tmp_path, seed=seed)) as recording:
        poses = recording.poses
        assert poses is not None
        for late in (0.05, -0.045):
            estimate = estimate_misalignment(recording, poses.shifted(-late))
            assert estimate is not None
            assert estimate.time_offset == pytest.approx(late, abs=3e-3)
            assert np.degrees(np.abs(estimate.rotation)).max() < 1.0
        recording.mount(Transform(np.zeros(3), quaternion_from_angles(0.0, 5.0, 0.0)))
        estimate = estimate_misalignment(recording, poses)
        assert estimate is not None and abs(estimate.time_offset) < 3e-3
        np.testing.assert_allclose(np.degrees(estimate.rotation), [0.0, -5.0, 0.0], atol=1.0)


def test_the_airframe_in_view_is_boxed(build: Build, flight: Flight):
    random = np.random.default_rng(0)
    box = np.array([0.21, 0.06, -0.14]), np.array([0.34, 0.14, -0.06])
    sweeps = []
    for time, points, at in flight.sweeps:
        arm = random.uniform(*box, (60, 3))
        sweeps.append((time, np.vstack([points, arm]), np.append(at, np.zeros(60, at.dtype))))
    found = findings(build(sweeps=sweeps))
    assert list(found) == ["airframe"]
    corners = np.array(found["airframe"].advice.split("--mask ")[1].split(), float)
    np.testing.assert_allclose(corners, np.concatenate(box), atol=0.06)


def test_a_post_beside_which_the_drone_waits_is_not_part_of_it(mcap_of: Callable[[list[bags.Item]], Path]):
    random = np.random.default_rng(0)
    walls = np.column_stack(
        [random.uniform(-4.0, 9.0, 400), random.choice([-3.0, 3.0], 400), random.uniform(0, 3, 400)]
    )
    post = np.column_stack([np.full(50, 0.6), np.full(50, 0.4), np.linspace(0.0, 3.0, 50)])
    items: list[bags.Item] = []
    for k in range(60):
        time, position = 0.1 * k, np.array([0.15 * max(k - 40, 0), 0.0, 1.5])
        points = (np.vstack([walls, post]) - position).astype(np.float32)
        items += [bags.cloud(time, bags.xyz(points)), bags.odometry(time, position)]
    assert "airframe" not in codes(mcap_of(items))


def test_poses_that_jump(build: Build, flight: Flight):
    jumped = flight.positions + np.outer(flight.times > 2.0, [0.0, 1.5, 0.0])
    evidence = findings(build(positions=jumped))["pose-jumps"].evidence
    found = re.search(r"by up to ([\d.]+) m .* at 2.0 s", evidence)
    assert found is not None and float(found[1]) == pytest.approx(1.5, abs=0.1), "the drone moves by 0.1 m meanwhile"


def test_dropped_sweeps_are_counted(build: Build, flight: Flight):
    found = findings(build(sweeps=flight.sweeps[:10] + flight.sweeps[13:30] + flight.sweeps[31:]))
    assert list(found) == ["dropped-sweeps"]
    start = f"about 4 of {len(flight.sweeps)} sweeps are missing: 2 gaps"
    assert found["dropped-sweeps"].evidence.startswith(start)


def test_a_long_gap_is_not_a_slow_disk(mcap_of: Callable[[list[bags.Item]], Path]):
    times = [0.1 * k + 3600.0 * (k >= 10) for k in range(20)]
    found = findings(mcap_of([bags.cloud(time, bags.xyz(bags.wall())) for time in times]))
    assert (
        list(found) == ["clock-jump"] and "jumps by 3600.1 s after the sweep at 0.9 s" in found["clock-jump"].evidence
    )


def test_coordinates_in_millimetres(mcap_of: Callable[[list[bags.Item]], Path]):
    points = 1e3 * bags.wall()
    points[:50] *= 10.0
    found = findings(mcap_of([bags.cloud(0.1 * k, bags.xyz(points)) for k in range(5)]))
    assert list(found) == ["units"] and "25 % are left out" in found["units"].evidence


def test_findings_are_printed_with_their_next_step(build: Build, capsys: pytest.CaptureFixture[str]):
    path = str(build(late=0.05))
    code, text, _ = run(capsys, "inspect", path)
    assert code == 0 and "FAULT (time-offset): the sweeps are stamped" in text and "Next: synchronize" in text
    found = run_json(capsys, "inspect", path)["findings"]
    assert [finding["code"] for finding in found] == ["time-offset"]
