"""Reports on folders of clouds, whose files say nothing before they are read."""

from pathlib import Path

import bags
import numpy as np

from aero_viz.recordings import inspect
from aero_viz.recordings.info import PointsPerSweep


def test_a_report_on_a_folder_counts_the_points_of_its_files(tmp_path: Path):
    for k, count in enumerate([500, 700, 3200]):
        np.save(tmp_path / f"{k}.npy", bags.wall(count))
    assert inspect(tmp_path).points_per_sweep == PointsPerSweep(500, 700, 3200)


def test_a_report_on_a_folder_names_the_files_that_cannot_be_read(tmp_path: Path):
    for k in range(10):
        np.save(tmp_path / f"{k}.npy", bags.wall(100))
    (tmp_path / "3.npy").write_bytes(b"")
    (tmp_path / "5.npy").write_bytes((tmp_path / "5.npy").read_bytes()[:1000])
    np.save(tmp_path / "7.npy", np.full((100, 3), np.nan))
    (tmp_path / "11.npy").symlink_to(tmp_path / "nothing.npy")
    info = inspect(tmp_path)
    (said,) = [problem for problem in info.problems if "play without points" in problem]
    assert said.startswith("3 of 10 files cannot be read") and "3.npy (it is empty)" in said
    assert "5.npy (it is truncated" in said and "7.npy (holds no finite points; give a cloud" in said
    assert "links to clouds that do not exist are left out: 11.npy" in info.problems
    assert info.points_per_sweep == PointsPerSweep(100, 100, 100)
