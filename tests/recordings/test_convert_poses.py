"""Poses that conversion writes in place of recorded ones: a converted recording plays as its source does."""

from collections.abc import Callable
from pathlib import Path

import bags
import numpy as np
import pytest
from command_line import run_json, run_refused

from aero_viz.recordings import Recording, open_recording
from aero_viz.recordings.convert import convert

Write = Callable[[list[bags.Item]], Path]
TURNED = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""90 deg about z."""


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    """Return a file of poses of a climb, every 0.05 s from 0.08 s before to 1.07 s after the start."""
    path = tmp_path / "climb.tum"
    times = bags.START * 1e-9 + np.arange(-0.08, 1.1, 0.05)
    path.write_text("".join(f"{time:.9f} 1 2 {k} 0 0 0 1\n" for k, time in enumerate(times)))
    return path


def late_clock(items: list[bags.Item]) -> list[bags.Item]:
    """Return messages that are recorded an hour after their stamps."""
    return [bags.Item(item.topic, item.type_name, item.time + 3600 * 10**9, item.build) for item in items]


def static(parent: str, child: str, position: tuple[float, ...], wxyz: tuple[float, ...] = (1, 0, 0, 0)) -> bags.Item:
    return bags.transform(0.0, parent, child, position, wxyz, topic="/tf_static")


def assert_same_playback(before: Recording, after: Recording) -> None:
    """Check that points and poses of the sweeps of a converted recording are those of its source."""
    shift = 1e-9 * (after.start - before.start)
    assert before.poses is not None and after.poses is not None and len(after.sweep_times) > 1
    for k, time in enumerate(after.sweep_times):
        index = int(np.abs(before.sweep_times - shift - time).argmin())
        np.testing.assert_allclose(after.sweep(k).points, before.sweep(index).points, atol=1e-5)
        pose, moved = before.poses.interpolate(before.sweep_times[index]), after.poses.interpolate(time)
        np.testing.assert_allclose(moved.position + after.poses.offset, pose.position + before.poses.offset, atol=1e-5)
        np.testing.assert_allclose(moved.quaternion, pose.quaternion, atol=1e-6)


@pytest.mark.parametrize(
    "mounting",
    [
        [static("base_link", "lidar", (0.1, 0, 0.2), TURNED)],
        [static("base_link", "plate", (0.1, 0, 0.2), TURNED), static("plate", "lidar", (0, 0.3, 0), TURNED)],
        [static("body", "lidar", (0.1, 0, 0.2), TURNED)],
        [static("odom", "base_link", (0, 0, 0)), static("base_link", "lidar", (0.1, 0, 0.2), TURNED)],
        [],
    ],
    ids=["mounted", "chain", "same-name", "fixed", "none"],
)
def test_new_poses_replace_the_recorded_ones_and_keep_the_mounting(
    mcap_of: Write, tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str], mounting: list[bags.Item]
):
    body = mounting[-1].build(bags.STORES[False], False).transforms[0].header.frame_id if mounting else "lidar"
    goals = [bags.pose_stamped(0.1 * k, (9, 9, 9)) for k in range(10)]
    imu = static("lidar", "imu", (0, 0, 0.1))
    source, target = mcap_of([*mounting, imu, *bags.drive(child=body), *goals]), tmp_path / "out.mcap"
    report = run_json(capsys, "convert", str(source), str(target), "--poses", str(poses))
    assert report["left_out"] == dict.fromkeys(("/odom", "/pose"), "other poses take its place")
    with open_recording(source, poses=poses) as before, open_recording(target) as after:
        assert after.pose_topic == "/odometry" and len(before.sweep_times) == len(after.sweep_times)
        np.testing.assert_allclose(after.extrinsic.position, before.extrinsic.position, atol=1e-9)
        assert_same_playback(before, after)


def test_another_mounting_replaces_the_recorded_one(
    mcap_of: Write, tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str]
):
    items = [static("base_link", "lidar", (0.1, 0, 0.2), TURNED), *bags.drive(child="base_link")]
    source, target = mcap_of(items), tmp_path / "out.mcap"
    arguments = ("--extrinsic", "0", "0", "1", "0", "0", "30")
    run_json(capsys, "convert", str(source), str(target), "--poses", str(poses), *arguments)
    extrinsic = [float(value) for value in arguments[1:]]
    with open_recording(source, poses=poses, extrinsic=extrinsic) as before, open_recording(target) as after:
        assert_same_playback(before, after)


def test_a_mounting_that_is_repeated_on_tf_is_kept(
    mcap_of: Write, tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str]
):
    mounting = [bags.transform(0.1 * k, "base_link", "lidar", (0.1, 0, 0.2), TURNED) for k in range(10)]
    source, target = mcap_of([*mounting, *bags.drive(child="base_link")]), tmp_path / "out.mcap"
    run_json(capsys, "convert", str(source), str(target), "--poses", str(poses))
    with open_recording(source, poses=poses) as before, open_recording(target) as after:
        assert_same_playback(before, after)


def test_poses_for_clouds_in_the_world_are_refused(
    mcap_of: Write, tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str]
):
    source = mcap_of([*bags.drive(parent="lidar", child="base_link")])
    error = run_refused(capsys, "convert", str(source), str(tmp_path / "out.mcap"), "--poses", str(poses))
    assert "clouds on /points are in the frame of the world, 'lidar'" in error
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("cut", [(), ("--start", "0.25", "--end", "0.55")])
def test_poses_are_chosen_by_the_clock_of_the_sweeps(
    mcap_of: Write, tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str], cut: tuple[str, ...]
):
    clouds = [item for item in bags.drive() if item.topic == "/points"]
    source, target = mcap_of(late_clock(clouds)), tmp_path / "out.mcap"
    report = run_json(capsys, "convert", str(source), str(target), "--poses", str(poses), *cut)
    assert report["topics"]["/odometry"] == (8 if cut else 23)
    with open_recording(source, poses=poses) as before, open_recording(target) as after:
        assert len(after.sweep_times) == (3 if cut else 10)
        assert_same_playback(before, after)


def test_poses_that_do_not_reach_the_part_are_a_note(
    mcap_of: Write, tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str]
):
    source, target = mcap_of(bags.drive(sweeps=60)), tmp_path / "out.mcap"
    arguments = ("--poses", str(poses), "--start", "4")
    report = run_json(capsys, "convert", str(source), str(target), *arguments)
    assert "the poses do not reach the chosen part of the recording: none is written" in report["notes"]
    assert "/odometry" not in report["topics"] and report["topics"]["/points"] == 20


def test_poses_next_to_the_clouds_are_written(tmp_path: Path, poses: Path, capsys: pytest.CaptureFixture[str]):
    clouds, target = tmp_path / "clouds", tmp_path / "out.mcap"
    clouds.mkdir()
    for k in range(4):
        np.save(clouds / f"{bags.START + k * 10**8}.npy", bags.wall(seed=k))
    poses.rename(clouds / "groundtruth.txt")
    report = run_json(capsys, "convert", str(clouds), str(target))
    assert "poses are those of groundtruth.txt (TUM)" in report["notes"]
    with open_recording(clouds) as before, open_recording(target) as after:
        assert_same_playback(before, after)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--mask", "-1", "-1", "-1", "1", "1", "1"), "--mask has no effect: clouds are written whole"),
        (("--mask", "-1", "-1", "-1", "1", "1", "1", "--poses", "{poses}"), "--mask has no effect"),
        (("--extrinsic", "0", "0", "1", "0", "0", "0"), "--extrinsic has no effect"),
        (("--extrinsic", "0", "0", "1", "0", "0", "0", "--odometry", "auto"), "--extrinsic has no effect"),
        (("--points-topic", "/points"), "name those to write with --topics"),
        (("--pose-topic", "/odom"), "name those to write with --topics"),
        (("--poses", "{poses}", "--odometry", "auto"), "--odometry has no effect with --poses"),
    ],
)
def test_flags_without_effect_are_refused(
    mcap_of: Write,
    tmp_path: Path,
    poses: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
):
    source, target = mcap_of(bags.drive()), tmp_path / "out.mcap"
    given = [argument.format(poses=poses) for argument in arguments]
    assert message in run_refused(capsys, "convert", str(source), str(target), *given)
    assert not target.exists()


def test_odometry_that_is_not_needed_is_a_note(mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    report = run_json(capsys, "convert", str(mcap_of(bags.drive())), str(tmp_path / "out.mcap"), "--odometry", "auto")
    assert report["notes"] == ["poses are recorded on /odom: no others are written"]


def test_the_mask_of_an_estimate_is_not_applied_and_a_note_says_so(mcap_of: Write, tmp_path: Path, poses: Path):
    source = mcap_of(bags.drive())
    with open_recording(source, poses=poses, mask=[-9, -9, -9, 9, 9, 9]) as recording:
        report = convert(source, tmp_path / "out.mcap", recording=recording)
    assert "the points in the mask are written: play the file with the same --mask" in report.notes
