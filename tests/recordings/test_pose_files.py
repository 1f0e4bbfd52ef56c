"""Files of poses: the names in their headers, the units of their times, and times that fit only part of the sweeps."""

from pathlib import Path

import bags
import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.recordings.pose_files import read_pose_file

POSE = "7 1 2 3 0.8 0 0 0.6"
HEADERS = {
    "#timestamp,tx,ty,tz,qw,qx,qy,qz": POSE,
    "# time x y z qw qx qy qz": POSE,
    "timestamp;tx;ty;tz;qw;qx;qy;qz": POSE,
    "# timestamp [s] tx ty tz qx qy qz qw": "7 1 2 3 0 0 0.6 0.8",
    "# a comment of eight words that names nothing": "7 1 2 3 0 0 0.6 0.8",
    "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]": f"{POSE} 9 9 9",
    "field.header.stamp,seq,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
    "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w": (
        "7 0 1 2 3 0 0 0.6 0.8"
    ),
    "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.child_frame_id,field.pose.pose.position.x,"
    "field.pose.pose.position.y,field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
    "field.pose.pose.orientation.z,field.pose.pose.orientation.w,field.pose.covariance0": (
        "9,0,7,the map,,1,2,3,0,0,0.6,0.8,nan"
    ),
}


@pytest.mark.parametrize("header", HEADERS)
def test_a_header_gives_the_columns_of_a_pose(tmp_path: Path, header: str):
    path = tmp_path / "poses.txt"
    path.write_text(f"{header}\n{HEADERS[header]}\n")
    table = read_pose_file(path)
    assert table.times is not None
    np.testing.assert_allclose([*table.times, *table.positions[0]], [7, 1, 2, 3])
    np.testing.assert_allclose(table.quaternions, [[0.8, 0, 0, 0.6]])
    assert table.notice == ""


def test_a_header_that_does_not_name_a_pose_is_refused(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text(f"# epoch x y z qw qx qy qz\n{POSE}\n")
    with pytest.raises(UserError, match="name them time x y z qx qy qz qw"):
        read_pose_file(path)
    path.write_text(f"# time x y z qw qx qy qz\n{POSE} 0\n")
    with pytest.raises(UserError, match="the 8 numbers that its header names"):
        read_pose_file(path)


def test_poses_that_are_upside_down_are_noted(tmp_path: Path):
    path = tmp_path / "poses.txt"
    path.write_text("0 1 2 3 1 0 0 0\n")
    assert "if its quaternions are qw qx qy qz" in read_pose_file(path).notice


def write_drive(folder: Path, start: float, sweeps: int = 20) -> None:
    """Write clouds of a wall that the sensor approaches at 2 m/s, 0.1 s apart, with their times in a text."""
    for k in range(sweeps):
        np.save(folder / f"{k}.npy", bags.wall(50) - [0.2 * k, 0, 0])
    (folder / "times.txt").write_text("".join(f"{start + 0.1 * k:.6f}\n" for k in range(sweeps)))


def tum(times: np.ndarray, scale: float = 1.0, start: float = 0.0) -> str:
    """Return the poses of the drive at some times [s], whose text counts from `start` in another unit."""
    return "".join(f"{round((start + t) * 1e6) * (scale / 1e6):.9f} {2 * t} 0 0 0 0 0 1\n" for t in times.tolist())


@pytest.mark.parametrize("start", [1_700_000_000.0, 1000.0])
@pytest.mark.parametrize(("scale", "unit"), [(1, ""), (1e3, "milli"), (1e6, "micro"), (1e9, "nano")])
@pytest.mark.parametrize("origin", ["stamps", "first sweep"])
def test_the_unit_of_the_times_of_poses_is_found(tmp_path: Path, start: float, scale: float, unit: str, origin: str):
    write_drive(tmp_path, start)
    first = start if origin == "stamps" else 0.0
    (tmp_path / "poses.txt").write_text(tum(np.arange(0.0, 2.0, 0.01), scale, first))
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None and len(recording.sweep_times) == 20
        for k in range(0, 20, 5):
            assert recording.poses.interpolate(recording.sweep_times[k]).position[0] == pytest.approx(0.2 * k, abs=1e-3)
        said = [problem for problem in recording.problems if problem.startswith("the times of poses.txt")]
        assert any(f"in {unit}seconds" in problem for problem in said) == bool(unit)
        assert any("counted from the first" in problem for problem in recording.problems) == (origin != "stamps")


@pytest.mark.parametrize("start", [1_700_000_000.0, 0.0])
def test_stamps_of_poses_that_cover_a_part_of_the_sweeps_are_kept(tmp_path: Path, start: float):
    write_drive(tmp_path, start)
    (tmp_path / "poses.txt").write_text(tum(np.arange(1.4, 2.0, 0.01), 1.0, start))
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None
        assert any("no pose covers sweeps 0..12 of 20" in problem for problem in recording.problems)
        assert recording.poses.interpolate(0.2).position[0] + recording.poses.offset[0] == pytest.approx(3.0, abs=1e-3)


STAMPS = [1_700_000_000.0 + 0.1 * k for k in range(-1, 5)]
"""Times of poses: one before those of the clouds below."""


def rows_of(form: str) -> list[str]:
    """Return lines with positions of 2 m/s along x, turned by 90 deg about z, in a form of a published data set."""
    half, lines = np.sqrt(0.5), []
    for k, time in enumerate(STAMPS):
        x, whole, rest = 0.2 * (k - 1), round(time * 1e9) // 10**9, round(time * 1e9) % 10**9
        matrix = f"0 -1 0 {x} 1 0 0 0 0 0 1 0"
        lines.append(
            {
                "nanoseconds and matrix": f"{whole * 10**9 + rest},{matrix.replace(' ', ',')}",
                "seconds and 4 x 4 matrix": f"{time:.6f} {matrix} 0 0 0 1",
                "seconds, nanoseconds": f"{whole},{rest},{x},0,0,0,0,{half},{half}",
                "number, time": f"{k} {time:.6f} {x} 0 0 0 0 {half} {half}",
                "secs and nsecs": f"{k},{whole},{rest},{x},0,0,{half},0,0,{half}",
                "header.stamp.sec": f"{whole},{rest},map,{x},0,0,0,0,{half},{half}".replace("map", "0"),
                "scientific": f"{whole * 10**9 + rest:.18e} {x} 0 0 0 0 {half} {half}",
            }[form]
        )
    return lines


@pytest.mark.parametrize(
    ("form", "header"),
    [
        ("nanoseconds and matrix", ""),
        ("seconds and 4 x 4 matrix", ""),
        ("seconds, nanoseconds", "#sec,nsec,x,y,z,qx,qy,qz,qw"),
        ("seconds, nanoseconds", ""),
        ("number, time", ""),
        ("number, time", "# index timestamp x y z qx qy qz qw"),
        ("secs and nsecs", "seq,header.stamp.secs,header.stamp.nsecs,p.x,p.y,p.z,q.w,q.x,q.y,q.z"),
        ("header.stamp.sec", "header.stamp.sec,header.stamp.nanosec,frame,pose.position.x,pose.position.y,"
         "pose.position.z,orientation.x,orientation.y,orientation.z,orientation.w"),
        ("scientific", ""),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["poses.csv", "other.txt"])
def test_poses_of_published_data_sets_play(tmp_path: Path, form: str, header: str, name: str):
    for k in range(4):
        np.save(tmp_path / f"{1_700_000_000 + 0.1 * k:.3f}.npy", bags.wall(50))
    (tmp_path / name).write_text("\n".join([header, *rows_of(form)]) + "\n")
    with open_recording(tmp_path, poses=None if name == "poses.csv" else tmp_path / name) as recording:
        assert recording.poses is not None and len(recording.sweep_times) == 4
        pose = recording.poses.interpolate(0.2)
        np.testing.assert_allclose(pose.position + recording.poses.offset, [0.4, 0, 0], atol=1e-3)
        np.testing.assert_allclose(pose.quaternion, np.sqrt(0.5) * np.array([1, 0, 0, 1]), atol=1e-6)


@pytest.mark.parametrize("counted", [True, False])
def test_a_part_of_the_clouds_plays_with_the_poses_of_all(tmp_path: Path, counted: bool):
    for k in (4, 7, 9):
        np.save(tmp_path / f"{k:06d}.npy", bags.wall(50))
    rows = [f"{k} " * counted + f"1 0 0 {2.0 * k} 0 1 0 0 0 0 1 0" for k in range(20) if not counted or k > 2]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None
        np.testing.assert_allclose(recording.poses.positions[:, 0] + recording.poses.offset[0], [8, 14, 18])
        assert any("with the numbers in the names" in text for text in recording.problems)


def test_clouds_without_their_poses_play_with_others(tmp_path: Path):
    for k in (4, 5, 77):
        np.save(tmp_path / f"{k:06d}.npy", bags.wall(50))
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 40)
    with pytest.raises(UserError, match=r"40 poses and .* 3 sweeps: .* --poses, or .* --odometry"):
        open_recording(tmp_path)
    (tmp_path / "three.txt").write_text("0 1 0 0 0 0 0 1\n0.1 2 0 0 0 0 0 1\n0.2 3 0 0 0 0 0 1\n")
    with open_recording(tmp_path, poses=tmp_path / "three.txt") as recording:
        assert recording.poses is not None and len(recording.sweep_times) == 3


@pytest.mark.parametrize("line", ["1 2 3", "1 2 3 4 5 6", "1 " * 11, "1 " * 18])
def test_lines_that_are_no_poses_are_refused(tmp_path: Path, line: str):
    (tmp_path / "poses.txt").write_text(f"{line}\n")
    with pytest.raises(UserError, match="every line must have 8 numbers"):
        read_pose_file(tmp_path / "poses.txt")


@pytest.mark.parametrize("line", ["1 2 3 4 5 6 7 F", "1,2,3,4,x\x1by,6,7,8", "1 2 3 4 5 6 7 \xff"])
def test_what_is_no_number_is_quoted(tmp_path: Path, line: str):
    (tmp_path / "poses.txt").write_text(f"{line}\n", encoding="latin-1")
    with pytest.raises(UserError, match=r"something else than numbers: '[^']+'\.") as caught:
        read_pose_file(tmp_path / "poses.txt")
    assert str(caught.value).isprintable() and "convert" not in str(caught.value)


@pytest.mark.parametrize("value", ["x", "0x1", "nan", "inf", "1e300", "7"])
def test_a_damaged_calibration_next_to_the_poses_is_named(tmp_path: Path, recwarn: pytest.WarningsRecorder, value: str):
    for k in range(3):
        np.save(tmp_path / f"{k:06d}.npy", bags.wall(50))
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    for place in (1, 3) if value != "7" else (1,):
        numbers = ["1", "0", "0", "0", "0", "1", "0", "0", "0", "0", "1", "0"]
        numbers[place] = value
        (tmp_path / "calib.txt").write_text(f"Tr: {' '.join(numbers)}\n")
        with pytest.raises(UserError, match=r"calib\.txt has no pose of the LiDAR at Tr: correct or remove it"):
            open_recording(tmp_path)
    assert not recwarn.list
