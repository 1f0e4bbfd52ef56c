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
        assert any(f"in {unit}seconds" in problem for problem in recording.problems) == bool(unit)
        assert any("counted from the first" in problem for problem in recording.problems) == (origin != "stamps")


@pytest.mark.parametrize("start", [1_700_000_000.0, 0.0])
def test_stamps_of_poses_that_cover_a_part_of_the_sweeps_are_kept(tmp_path: Path, start: float):
    write_drive(tmp_path, start)
    (tmp_path / "poses.txt").write_text(tum(np.arange(1.4, 2.0, 0.01), 1.0, start))
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None
        assert any("no pose covers sweeps 0..12 of 20" in problem for problem in recording.problems)
        assert recording.poses.interpolate(0.2).position[0] + recording.poses.offset[0] == pytest.approx(3.0, abs=1e-3)
