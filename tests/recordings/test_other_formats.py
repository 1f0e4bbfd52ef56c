"""Recordings that are not bags, written by the libraries that define their formats."""

import base64
import importlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bags
import laspy
import numpy as np
import pytest
from captures import livox_packets, write_las, write_lvx2, write_mid360, write_ulog, write_vlp16
from command_line import run, run_json, run_refused
from mcap.writer import Writer

from aero_viz.errors import UserError
from aero_viz.recordings import RecordingSource, open_recording
from aero_viz.recordings.convert import convert
from aero_viz.recordings.imu import read_imu
from aero_viz.recordings.pose_files import read_in_process, read_pose_file
from aero_viz.recordings.storage import open_storage

pytest.importorskip("dpkt", reason="the extra 'formats' is not installed")


WALL = bags.wall(500)


def write_open3d(path: Path, points: np.ndarray, **options: Any) -> None:
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    assert open3d.io.write_point_cloud(path, cloud, **options)


WRITERS: dict[str, Callable[[Path, np.ndarray], object]] = {
    "ascii.pcd": lambda path, points: write_open3d(path, points, write_ascii=True),
    "binary.pcd": lambda path, points: write_open3d(path, points),
    "packed.pcd": lambda path, points: write_open3d(path, points, compressed=True),
    "cloud.ply": lambda path, points: write_open3d(path, points),
    "cloud.las": write_las,
    "cloud.laz": write_las,
    "cloud.npy": lambda path, points: np.save(path, points),
    "organised.npy": lambda path, points: np.save(path, points.reshape(20, -1, 3)),
    "cloud.bin": lambda path, points: np.column_stack([points, np.ones(len(points))]).astype("<f4").tofile(path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_single_cloud_is_one_sweep(tmp_path: Path, name: str):
    path = tmp_path / name
    WRITERS[name](path, WALL)
    with open_recording(path) as recording:
        assert recording.format == path.suffix[1:]
        np.testing.assert_allclose(recording.sweep(0).points, WALL, atol=1e-4)
        is_map = path.suffix != ".bin"
        assert any(f"aero-viz demo {name}" in problem for problem in recording.problems) == is_map


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_of_clouds_plays_with_tum_poses(tmp_path: Path, name: str):
    suffix = Path(name).suffix
    for k in range(4):
        WRITERS[name](tmp_path / f"{1_700_000_000 + k}.{500_000_000:09d}{suffix}", WALL - [0.5 * k, 0, 0])
    rows = [f"{1_700_000_000.5 + k} {10 + 0.5 * k} 2 3 0 0 0 1" for k in range(4)]
    (tmp_path / "poses.txt").write_text("# time x y z qx qy qz qw\n" + "\n".join(rows) + "\n")
    with open_recording(tmp_path) as recording:
        assert recording.format == f"folder of {suffix[1:]}" and recording.poses is not None
        np.testing.assert_allclose(recording.sweep_times, [0.0, 1.0, 2.0, 3.0])
        for k in range(4):
            pose = recording.poses.interpolate(float(k))
            world = recording.sweep(k).points + pose.position + recording.poses.offset
            np.testing.assert_allclose(world, WALL + np.array([10, 2, 3]), atol=1e-3)


def write_timed(path: Path, points: np.ndarray, name: str, times: np.ndarray, ascii: bool) -> None:
    if path.suffix in (".las", ".laz"):
        write_las(path, points)
        las = laspy.read(path)
        if name != "gps_time":
            las.add_extra_dim(laspy.ExtraBytesParams(name, times.dtype.str))
        las[name] = times
        las.write(str(path))
        return
    open3d: Any = importlib.import_module("open3d")

    cloud = open3d.t.geometry.PointCloud(open3d.core.Tensor(points.astype("f4")))
    cloud.point[name] = open3d.core.Tensor(times.reshape(-1, 1))
    assert open3d.t.io.write_point_cloud(str(path), cloud, write_ascii=ascii)


@pytest.mark.parametrize(
    ("suffix", "name", "times"),
    [
        ("pcd", "t", lambda start, s: (1e9 * s).astype("u4")),
        ("pcd", "timestamp", lambda start, s: start + s),
        ("ascii pcd", "offset_time", lambda start, s: (1e9 * s).astype("u4")),
        ("ply", "scalar_GpsTime", lambda start, s: 3e5 + s),
        ("ply", "time", lambda start, s: (1e6 * s).astype("f4")),
        ("ascii ply", "t", lambda start, s: 1e3 * s),
        ("las", "gps_time", lambda start, s: start - 1_315_964_782 + s),
        ("laz", "time_offset", lambda start, s: (1e6 * (s - 0.1)).astype("i4")),
    ],
)
def test_times_of_points_deskew_a_folder_of_clouds(tmp_path: Path, suffix: str, name: str, times: Any):
    form, suffix, seconds = suffix.split()[0], suffix.split()[-1], np.linspace(0.0, 0.1, len(WALL))
    for k in range(3):
        start = 1_700_000_000 + 0.1 * k
        values = times(start, seconds)
        since = 0.1 * k + seconds - (0.1 if values.min() < 0 else 0.0)
        moved = WALL - 3.0 * since[:, None] * [1, 0, 0]
        write_timed(tmp_path / f"{start:.1f}.{suffix}", moved, name, values, form == "ascii")
    rows = [f"{1_700_000_000 - 0.2 + 0.05 * i} {0.15 * i - 0.6} 0 0 0 0 0 1" for i in range(20)]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    with open_recording(tmp_path) as recording:
        assert recording.sweep(1).point_times is not None and recording.poses is not None
        source = RecordingSource(recording, sweeps=1)
        source.seek(0.2)
        np.testing.assert_allclose(source.observe().points + recording.poses.offset, WALL, atol=2e-3)


def test_kitti_with_times_and_one_pose_per_sweep(tmp_path: Path):
    (tmp_path / "velodyne").mkdir()
    for k in range(3):
        WRITERS["cloud.bin"](tmp_path / "velodyne" / f"{k:06d}.bin", WALL)
    (tmp_path / "times.txt").write_text("0.0\n0.104\n0.208\n")
    matrices = [np.hstack([np.eye(3), [[2.0 * k], [0], [0]]]).reshape(-1) for k in range(3)]
    np.savetxt(tmp_path / "poses.txt", matrices)
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.104, 0.208], atol=1e-9)
        np.testing.assert_allclose(recording.poses.positions[:, 0], [0, 2, 4])
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(UserError, match=r"has 1 poses and .* 3 sweeps"):
        open_recording(tmp_path)


def check_livox(path: Path, name: str) -> None:
    with open_recording(path) as recording:
        assert recording.format == name
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.1, 0.2], atol=1e-9)
        sweep = recording.sweep(1)
        np.testing.assert_allclose(sweep.points[50:100], WALL[:50] + 0.021, atol=6e-4)
        assert sweep.point_times is not None
        assert sweep.point_times[50] == pytest.approx(0.005) and len(sweep.points) == 1000


def test_a_capture_of_a_mid360(tmp_path: Path):
    path = write_mid360(tmp_path / "mid360.pcap")
    check_livox(path, "livox-pcap")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])  # a truncated capture plays up to the cut
    with open_recording(path) as recording:
        assert 1 <= len(recording.sweep_times) <= 2


def test_an_lvx2_file(tmp_path: Path):
    check_livox(write_lvx2(tmp_path / "mid360.lvx2", livox_packets(3)), "lvx2")
    (tmp_path / "old.lvx").write_bytes(b"livox_tech".ljust(16, b"\0") + bytes([1, 1, 0, 0]) + bytes(20))
    with pytest.raises(UserError, match="Livox Viewer 2"):
        open_recording(tmp_path / "old.lvx")


def test_a_capture_of_a_velodyne(tmp_path: Path):
    with open_recording(write_vlp16(tmp_path / "vlp16.pcap")) as recording:
        assert recording.format == "velodyne-pcap" and len(recording.sweep_times) >= 3
        sweep = recording.sweep(1)
        np.testing.assert_allclose(np.linalg.norm(sweep.points, axis=1), 8.0, atol=0.1)
        assert len(sweep.points) > 20_000 and sweep.point_times is not None
        assert 0.05 < float(np.ptp(sweep.point_times)) < 0.11


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("new.pcap", b"\x0a\x0d\x0d\x0a" + bytes(20), "it has none of UDP"),
        ("flight.ulg", b"ULog\x01\x12\x35\x01", "flight.ulg cannot be read"),
        ("odd.bin", bytes(17), "no rows that start with x, y, z"),
        ("random.bin", np.random.default_rng(0).bytes(16_000), "within the range of any LiDAR"),
        ("text.bin", b"These are not points" * 100, "within the range of any LiDAR"),
        ("flight.zip", b"PK\3\4" + bytes(30), "unpack this archive"),
        ("flight.tar", bytes(257) + b"ustar" + bytes(250), "tar -xf"),
        ("scan.e57", b"ASTM-E57" + bytes(40), "its part of XML begins with no element"),
        ("garbage.npy", b"\x93NUMPY\x07\x09" + bytes(range(255, 100, -1)), "header is damaged"),
        ("head.pcap", b"\xd4\xc3\xb2\xa1", "truncated in its header"),
        ("empty.pcap", b"\xd4\xc3\xb2\xa1" + bytes(16) + b"\1\0\0\0", "no packets of a Livox"),
    ],
)
def test_what_cannot_be_played_names_the_next_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes, message: str
):
    path = tmp_path / name
    path.write_bytes(content)
    error = run_refused(capsys, "inspect", str(path))
    assert message in error and name in error


def test_the_bytes_of_a_cloud_decide_its_format(tmp_path: Path):
    write_open3d(tmp_path / "cloud.pcd", WALL)
    for name in ("cloud", "cloud.ply"):
        (tmp_path / name).write_bytes((tmp_path / "cloud.pcd").read_bytes())
        with open_recording(tmp_path / name) as recording:
            assert recording.format == "pcd"
            np.testing.assert_allclose(recording.sweep(0).points, WALL, atol=1e-4)


def test_arrays_may_have_a_row_per_coordinate_or_named_fields(tmp_path: Path):
    np.save(tmp_path / "rows.npy", WALL.T)
    times = 1000 * np.arange(len(WALL), dtype=np.uint32)
    np.save(
        tmp_path / "named.npy",
        np.rec.fromarrays([times, *WALL.T], np.dtype([("t", "u4"), ("x", "f4"), ("y", "f4"), ("z", "f4")])),
    )
    for name in ("rows", "named"):
        with open_recording(tmp_path / f"{name}.npy") as recording:
            np.testing.assert_allclose(recording.sweep(0).points, WALL, atol=1e-4)
    np.save(tmp_path / "odd.npy", np.rec.fromarrays([*WALL.T], np.dtype([("x", "f4"), ("y", "f4"), ("height", "f4")])))
    with pytest.raises(UserError, match="no field z"):
        open_recording(tmp_path / "odd.npy")


def test_an_empty_name_is_refused(capsys: pytest.CaptureFixture[str]):
    assert "name of the recording is empty" in run_refused(capsys, "inspect", "")


def test_a_bin_may_hold_missing_returns_and_some_damaged_points(tmp_path: Path):
    rows = np.zeros((1000, 4), "<f4")
    rows[:100, :3] = bags.wall(100)
    rows[100:150, :3] = np.nan
    rows.tofile(tmp_path / "cloud.bin")
    with open_recording(tmp_path / "cloud.bin") as recording:
        assert len(recording.sweep(0).points) == 100


def test_a_cloud_of_foxglove(tmp_path: Path):
    foxglove = pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
    from foxglove.channels import PointCloudChannel
    from foxglove.messages import PackedElementField, PackedElementFieldNumericType, PointCloud, Timestamp

    path = tmp_path / "foxglove.mcap"
    kind = PackedElementFieldNumericType.Float32
    fields = [PackedElementField(name=axis, offset=4 * i, type=kind) for i, axis in enumerate("xyz")]
    with foxglove.open_mcap(str(path)):
        channel = PointCloudChannel("/cloud")
        for k in range(3):
            stamp = Timestamp(sec=1_700_000_000, nsec=100_000_000 * k)
            data = (WALL + 0.1 * k).astype("<f4").tobytes()
            cloud = PointCloud(timestamp=stamp, frame_id="lidar", point_stride=12, fields=fields, data=data)
            channel.log(cloud, log_time=1_700_000_000_000_000_000 + 100_000_000 * k)
    with open_recording(path) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.1, 0.2])
        np.testing.assert_allclose(recording.sweep(2).points, WALL + 0.2, atol=1e-5)


@pytest.mark.parametrize(
    ("orientation", "expected"),
    [
        ({"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0}, np.add(WALL * [-1, -1, 1], [1, 2, 3])),
        ({"x": 0.0, "y": 0.0, "z": 0.0, "w": 0.0}, np.add(WALL, [1, 2, 3])),
        (None, np.add(WALL, [1, 2, 3])),
    ],
)
def test_a_cloud_of_foxglove_in_json_with_a_pose(tmp_path: Path, orientation: dict[str, float] | None, expected):
    path, start = tmp_path / "json.mcap", 1_700_000_000
    kind = np.dtype([(axis, "<u4" if axis == "t" else "<f8") for axis in "xyzt"])
    rows = np.rec.fromarrays([*WALL.T, 200_000 * np.arange(500)], kind)
    fields = [{"name": axis, "offset": 8 * i, "type": 5 if axis == "t" else 8} for i, axis in enumerate("xyzt")]
    pose = {"position": {"x": 1.0, "y": 2.0, "z": 3.0}, **({"orientation": orientation} if orientation else {})}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.PointCloud", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/cloud", "json", schema)
        for k in range(3):
            data = base64.b64encode(rows.tobytes()).decode()
            cloud = {"timestamp": {"sec": start + k, "nsec": 5}, "frame_id": "lidar", "pose": pose, "fields": fields}
            message = json.dumps({**cloud, "point_stride": rows.itemsize, "data": data}).encode()
            writer.add_message(channel, (start + k) * 10**9, message, (start + k) * 10**9)
        writer.finish()
    with open_recording(path) as recording:
        sweep = recording.sweep(2)
        np.testing.assert_allclose(recording.sweep_times, [0.0, 1.0, 2.0])
        np.testing.assert_allclose(sweep.points, expected, atol=1e-5)
        np.testing.assert_allclose(sweep.point_times, rows.t * 1e-9, atol=1e-7)  # type: ignore[arg-type]
        said = [problem for problem in recording.problems if "orientation" in problem]
        assert len(said) == (0 if orientation and any(orientation.values()) else 1)


def test_the_state_of_px4_is_aligned_by_gps_time(tmp_path: Path, mcap_of: Callable[[list[bags.Item]], Path]):
    path = mcap_of([bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(20)])
    log = write_ulog(tmp_path / "flight.ulg", 200, utc=bags.START * 1e-9 - 5.5)
    with open_recording(path, poses=log) as recording:
        assert recording.poses is not None and recording.pose_topic == "flight.ulg"
        assert any("aligned by GPS time" in problem for problem in recording.problems)
        pose = recording.poses.interpolate(1.0)
        # East, north, up; the log starts 0.5 s before the first sweep.
        np.testing.assert_allclose(pose.position + recording.poses.offset, [0.0, 3.0, 3.0], atol=1e-3)
        np.testing.assert_allclose(pose.velocity, [0.0, 2.0, 0.0], atol=1e-4)
        np.testing.assert_allclose(np.abs(pose.quaternion), [1.0, 0.0, 0.0, 0.0], atol=1e-6)  # east is x
    with open_recording(path, poses=write_ulog(log, 200, utc=None)) as recording:
        assert any("is assumed" in problem for problem in recording.problems)


def test_a_log_of_px4_is_checked_against_what_the_node_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = tmp_path / "flight.ulg"
    for hover, fits in ((0.41, True), (0.62, False)):
        write_ulog(path, 20, utc=None, parameters={"COM_OBL_RC_ACT": 3.0, "MPC_THR_HOVER": 0.4}, hover=hover)
        checks = {check["name"]: check for check in run_json(capsys, "inspect", str(path))["checks"]}
        assert f"{hover:.3f}" in checks["hover thrust"]["finding"] and checks["MPC_THR_HOVER"]["ok"] == fits
        assert not checks["COM_OBL_RC_ACT"]["ok"] and "Set it to 5" in checks["COM_OBL_RC_ACT"]["advice"]
    assert "not estimated" in run(capsys, "inspect", str(write_ulog(path, 20, utc=None)))[1]
    with pytest.raises(UserError, match="--poses plays it"):
        open_recording(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "every line must have 8 numbers"),
        ("0 0 0 0 0 0 0 x\n", "something else than numbers"),
        ("0 0 0 0 0 0 0 nan\n", "not finite"),
        ("0 0 0 0 0 0 0 0\n", "the quaternion of pose 1 has the length 0"),
        ("1 0 0 0 0 1 0 0 0 0 7 0\n", "not rotations"),
        ("", "holds no poses"),
    ],
)
def test_texts_without_poses_are_refused(tmp_path: Path, text: str, message: str):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        read_pose_file(path)


def test_a_log_that_its_reader_fails_on_is_named(tmp_path: Path):
    path = write_ulog(tmp_path / "flight.ulg", 2, utc=None)
    with pytest.raises(UserError, match=r"flight\.ulg cannot be read: unexpected TypeError"):
        read_in_process(os.abort, path)  # type: ignore[arg-type]


def test_mounting_and_mask_are_applied(mcap_of: Callable[[list[bags.Item]], Path]):
    path = mcap_of(bags.drive())
    with open_recording(path, extrinsic=(1, 0, 0.5, 0, 0, 90), mask=(-9, 3, -9, 9, 9, 9)) as recording:
        turned = recording.sweep(0).points
    wall = bags.wall(seed=0)
    expected = np.column_stack([1.0 - wall[:, 1], wall[:, 0], wall[:, 2] + 0.5])
    assert len(turned) == 0  # the whole wall is at y = 5
    with open_recording(path, extrinsic=(1, 0, 0.5, 0, 0, 90)) as recording:
        np.testing.assert_allclose(recording.sweep(0).points, expected, atol=1e-5)


def test_clouds_and_packets_convert_to_mcap(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write_lvx2(tmp_path / "mid360.lvx2", livox_packets(3))
    run_json(capsys, "convert", str(path), str(tmp_path / "out.mcap"))
    with open_recording(path) as before, open_recording(tmp_path / "out.mcap") as after:
        assert after.format == "mcap"
        np.testing.assert_array_equal(before.sweep(1).points, after.sweep(1).points)
        np.testing.assert_allclose(before.sweep(1).point_times, after.sweep(1).point_times)  # type: ignore[arg-type]


def test_the_imu_of_a_mid360_is_read_and_converted(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write_mid360(tmp_path / "mid360.pcap")
    topics = {topic["name"]: topic for topic in run_json(capsys, "inspect", str(path))["topics"]}
    assert topics["/livox/imu"]["count"] == 60 and topics["/livox/imu"]["type"] == "sensor_msgs/msg/Imu"
    convert(path, tmp_path / "out.mcap")
    for source in (path, tmp_path / "out.mcap"):
        storage = open_storage(source)
        imu = read_imu(storage.files)
        storage.close()
        assert imu is not None and imu.topic == "/livox/imu" and len(imu.times) == 60
        assert imu.times[0] == livox_packets(1)[0][0]
        np.testing.assert_allclose(imu.rates[0], [0.1, 0.2, 0.3], rtol=1e-6)
        np.testing.assert_allclose(imu.forces[0], [0.0, 0.0, 9.80665], rtol=1e-6)
