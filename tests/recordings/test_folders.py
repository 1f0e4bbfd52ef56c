"""Folders as public data sets have them, parts of one recording, and compressed files."""

import bz2
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path

import bags
import lz4.frame
import numpy as np
import pytest
import zstandard
from command_line import run_refused

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording

WALL = bags.wall(500)


def write_bins(folder: Path, names: list[str], columns: int = 4) -> None:
    """Write walls that approach by 2 m per file, with a ring in the fifth column."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        more = [np.full(len(WALL), 0.5), np.arange(len(WALL)) % 32][: columns - 3]
        np.column_stack([WALL - [2.0 * k, 0, 0], *more]).astype("<f4").tofile(folder / name)


def test_raw_data_of_kitti_have_dates(tmp_path: Path):
    write_bins(tmp_path / "velodyne_points" / "data", [f"{k:010d}.bin" for k in range(3)])
    dates = "".join(f"2011-09-26 13:02:{25 + 0.5 * k:012.9f}\n" for k in range(3))
    (tmp_path / "velodyne_points" / "timestamps.txt").write_text(dates)
    for path in (tmp_path, tmp_path / "velodyne_points", tmp_path / "velodyne_points" / "data"):
        with open_recording(path) as recording:
            np.testing.assert_allclose(recording.sweep_times, [0.0, 0.5, 1.0], atol=1e-6)
            assert recording.start == pytest.approx(1_317_042_145_000_000_000)


def test_raw_data_of_kitti_play_with_the_poses_of_the_imu_also_where_clouds_are_missing(tmp_path: Path):
    drive, speed = tmp_path / "2011_09_26" / "2011_09_26_drive_0009_sync", 2.0
    write_bins(drive / "velodyne_points" / "data", [f"{k:010d}.bin" for k in (0, 2, 3)])
    (drive / "oxts" / "data").mkdir(parents=True)
    for k in range(4):  # it flies north, and its LiDAR looks to its left: west
        latitude, up = 49.0 + np.degrees(0.1 * k * speed / 6_378_137.0), 100.0 + 0.01 * k
        row = [latitude, 8.4, up, 0.0, 0.0, np.pi / 2, speed, 0.0, speed, 0.0, 0.1, *np.zeros(19)]
        (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{value:.12f}" for value in row))
    dates = "".join(f"2011-09-26 13:02:{25 + 0.1 * k:012.9f}\n" for k in range(4))
    for folder in ("velodyne_points", "oxts"):
        (drive / folder / "timestamps.txt").write_text(dates)
    (drive.parent / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 0 1 0 -1 0 0 0 0 1\nT: 0 0.8 0\n")
    for path in (drive, drive / "velodyne_points", drive / "velodyne_points" / "data"):
        with open_recording(path) as recording:
            assert recording.poses is not None and recording.pose_topic == "oxts"
            assert any("calib_imu_to_velo.txt places" in problem for problem in recording.problems)
            np.testing.assert_allclose(recording.sweep_times, [0.0, 0.2, 0.3], atol=1e-6)
            pose = recording.poses.interpolate(0.2)
            np.testing.assert_allclose(pose.position, [0.0, 0.4, 0.02], atol=1e-4)
            np.testing.assert_allclose(pose.velocity, [0.0, speed, 0.1], atol=1e-6)
            # The wall is 5 m along the LiDAR's x, which is the IMU's y, and the LiDAR is 0.8 m in front of the IMU.
            np.testing.assert_allclose(recording.sweep(0).points[:, 1], WALL[:, 0], atol=1e-4)
            np.testing.assert_allclose(recording.sweep(0).points[:, 0], 0.8 - WALL[:, 1], atol=1e-4)
    for damaged in (
        "R: 0 1 0",
        "R: 0 1 0 -1 0 0 0 0 1",
        "R: 1 1 1 1 1 1 1 1 1\nT: 0 0 0",
        "R: 0 1 0 -1 0 0 0 0 1\nT: 0 nan 0",
    ):
        (drive.parent / "calib_imu_to_velo.txt").write_text(damaged)
        with pytest.raises(UserError, match=r"calib_imu_to_velo\.txt holds no rotation R and translation T"):
            open_recording(drive)
    (drive.parent / "calib_imu_to_velo.txt").unlink()
    (drive / "oxts" / "data" / "0000000002.txt").write_text("49.0 8.4 x")
    with pytest.raises(UserError, match=r"0000000002\.txt is not a row of KITTI's oxts"):
        open_recording(drive)


def test_odometry_of_kitti_is_moved_from_the_camera_to_the_lidar(tmp_path: Path):
    sequence = tmp_path / "sequences" / "04"
    write_bins(sequence / "velodyne", [f"{k:06d}.bin" for k in range(3)])
    (sequence / "times.txt").write_text("0.0\n0.1\n0.2\n")
    # The camera looks along the LiDAR's x, and is 0.3 m in front of it.
    (sequence / "calib.txt").write_text("P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 0 1 0 0 -0.3\n")
    (tmp_path / "poses").mkdir()
    rows = [np.hstack([np.eye(3), [[0.0], [0.0], [2.0 * k]]]).reshape(-1) for k in range(3)]
    np.savetxt(tmp_path / "poses" / "04.txt", rows)
    for path in (sequence, sequence / "velodyne"):
        with open_recording(path) as recording:
            assert recording.poses is not None
            np.testing.assert_allclose(recording.poses.positions, [[0, 0, 0], [2, 0, 0], [4, 0, 0]], atol=1e-9)
            np.testing.assert_allclose(np.abs(recording.poses.quaternions[:, 0]), 1.0)
            assert any("calib.txt moves them" in problem for problem in recording.problems)


def test_clouds_of_nuscenes_have_five_columns_and_a_time_in_their_names(tmp_path: Path):
    names = [f"n015-2018-07-24-11-22-45+0800__LIDAR_TOP__{1532402927647951 + 50_000 * k}.pcd.bin" for k in range(3)]
    write_bins(tmp_path, names, columns=5)
    with open_recording(tmp_path) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.05, 0.1], atol=1e-9)
        np.testing.assert_allclose(recording.sweep(1).points, WALL - [2, 0, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["cloud_1583836591_182590976.bin", "cloud_1583836591_282590976.bin"], [0.0, 0.1]),
        (["scan-1700000000.500.bin", "scan-1700000001.25.bin"], [0.0, 0.75]),
        (["1700000000000000000.bin", "1700000000250000000.bin"], [0.0, 0.25]),
        (["scans_2.bin", "scans_10.bin"], [0.0, 0.1]),
        (["0.9.bin", "0.10e1.bin"], [0.0, 0.1]),
    ],
)
def test_the_names_of_clouds_give_their_order_and_time(tmp_path: Path, names: list[str], times: list[float]):
    write_bins(tmp_path, names)
    with open_recording(tmp_path) as recording:
        np.testing.assert_allclose(recording.sweep_times, times, atol=1e-9)
        assert recording.sweep(1).points[0, 0] == pytest.approx(3.0)


def test_parts_of_a_split_bag_are_one_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    items = bags.drive()
    for part, minute in enumerate((0, 5)):
        bags.write_ros1(tmp_path / f"walk_2021-05-04-10-0{minute}-00_{part}.bag", items[part::2])
    (tmp_path / "calibration.yaml").write_text("camera: 1")
    with open_recording(tmp_path) as recording:
        assert len(recording.sweep_times) == 10 and recording.format == "rosbag1"
    bags.write_ros1(tmp_path / "other.bag", items)
    assert "choose one of" in run_refused(capsys, "inspect", str(tmp_path))


def test_a_folder_with_one_bag_and_the_metadata_of_a_folder_open(tmp_path: Path):
    (tmp_path / "one").mkdir()
    bags.write_ros1(tmp_path / "one" / "walk.bag", bags.drive())
    folder = bags.write_ros2(tmp_path / "bag", bags.drive(), "sqlite3", "file")
    for path in (tmp_path / "one", folder / "metadata.yaml"):
        with open_recording(path) as recording:
            assert len(recording.sweep_times) == 10
    (folder / "metadata.yaml").unlink()
    with open_recording(folder) as recording:
        assert len(recording.sweep_times) == 10


COMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    "gz": gzip.compress,
    "bz2": bz2.compress,
    "xz": lzma.compress,
    "lz4": lz4.frame.compress,
    "zst": zstandard.compress,
}


@pytest.mark.parametrize("suffix", COMPRESSORS)
def test_a_compressed_file_opens_as_the_file_in_it(tmp_path: Path, suffix: str):
    bag = bags.write_ros1(tmp_path / "a.bag", bags.drive())
    packed = tmp_path / f"packed.bag.{suffix}"
    packed.write_bytes(COMPRESSORS[suffix](bag.read_bytes()))
    with open_recording(packed) as recording:
        assert len(recording.sweep_times) == 10 and recording.problems == []
    whole = packed.read_bytes()
    packed.write_bytes(whole[: len(whole) // 2])
    try:
        with open_recording(packed) as recording:
            assert any("packed.bag" in problem and "truncated" in problem for problem in recording.problems)
    except UserError as error:  # a small file is one block
        assert "packed.bag" in str(error) and "truncated" in str(error)
    np.save(tmp_path / "cloud.npy", WALL)
    packed = tmp_path / f"cloud.npy.{suffix}"
    packed.write_bytes(COMPRESSORS[suffix]((tmp_path / "cloud.npy").read_bytes()))
    with open_recording(packed) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, WALL, atol=1e-4)
    packed.write_bytes(COMPRESSORS[suffix](b"\x93NUMPY"))
    with pytest.raises(UserError) as caught:
        open_recording(packed)
    assert str(packed) in str(caught.value)


def test_clouds_that_are_no_sweeps_are_left_out_with_a_note(tmp_path: Path):
    write_bins(tmp_path, [f"{1_700_000_000 + k}.000.bin" for k in range(4)])
    write_bins(tmp_path, ["GlobalMap.bin"])
    np.save(tmp_path / "5.npy", WALL)
    with open_recording(tmp_path) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0, 1, 2, 3])
        (said,) = [problem for problem in recording.problems if "left out" in problem]
        assert said.endswith(": 5.npy, GlobalMap.bin")


def test_a_folder_of_bags_and_clouds_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name in "ab":
        bags.write_ros1(tmp_path / f"{name}.bag", bags.drive())
    np.save(tmp_path / "map.npy", WALL)
    assert "choose one of a.bag, b.bag. Clouds play from a folder" in run_refused(capsys, "inspect", str(tmp_path))


@pytest.mark.parametrize(
    "lines",
    [
        "0 {0}\n1 {1}\n2 {2}\n",
        "1,{0}\n2,{1}\n3,{2}\n",
        "#timestamp [s],filename\n{0},0.bin\n{1},1.bin\n{2},2.bin\n",
        "index time\n0 {0}\n1 {1}\n2 {2}\n",
        "0.bin {0}\n1.bin {1}\n2.bin {2}\n",
        "{0} 0\n{1} 1\n{2} 2\n",
    ],
)
def test_times_may_have_other_columns(tmp_path: Path, lines: str):
    write_bins(tmp_path, [f"{k}.bin" for k in range(3)])
    (tmp_path / "timestamps.txt").write_text(lines.format(1_700_000_000.0, 1_700_000_000.25, 1_700_000_000.5))
    with open_recording(tmp_path) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0, 0.25, 0.5], atol=1e-6)


def test_parts_without_metadata_are_one_recording_only_if_they_are_numbered_from_zero(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    items = bags.drive()
    bags.write_mcap(tmp_path / "rec_0.mcap", items[: len(items) // 2])
    bags.write_mcap(tmp_path / "rec_2.mcap", items[len(items) // 2 :])
    with open_recording(tmp_path) as recording:
        assert any("copy rec_1.mcap" in problem for problem in recording.problems)
    (tmp_path / "rec_0.mcap").rename(tmp_path / "rec_1.mcap")
    assert "choose one of rec_1.mcap, rec_2.mcap" in run_refused(capsys, "inspect", str(tmp_path))
