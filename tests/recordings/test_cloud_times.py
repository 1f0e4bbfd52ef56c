"""Times of clouds that are in their names or in a text, whatever these count."""

from decimal import Decimal
from pathlib import Path

import bags
import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.recordings.cloud_times import find_clock, order_clouds, stamps_in_names

WALL = bags.wall(300)


def write_clouds(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, name in enumerate(names):
        np.save(folder / "cloud.tmp.npy", WALL - [0.2 * k, 0, 0])
        (folder / "cloud.tmp.npy").rename(folder / f"{name}.npy")


STARTS = {
    "since boot": 251_370,
    "since boot, long ago": 1_040_000,
    "GPS time of the week": 518_400,
    "GPS time": 1_380_000_000,
    "since 1970": 1_700_000_000,
}


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("unit", [10**3, 10**6, 10**9])
@pytest.mark.parametrize("step", [0.02, 0.1, 0.5, 2.0])
@pytest.mark.parametrize("form", ["{}", "cloud_{}", "n015-2018-07-24__LIDAR__{}"])
def test_whole_numbers_in_names_are_times_in_the_unit_in_which_clouds_follow_like_sweeps(
    start: str, unit: int, step: float, form: str
):
    names = [form.format(STARTS[start] * unit + round(step * k * unit) + k % 2) for k in range(5)]
    stamps, notice = stamps_in_names([Path(f"{name}.npy") for name in names])
    if STARTS[start] * unit < 10**8:  # too few digits for a time
        assert not stamps
        return
    np.testing.assert_allclose(1e-9 * np.diff([*stamps.values()]), step, atol=4e-3)
    assert "numbers in the names" in notice


@pytest.mark.parametrize(
    ("names", "step"),
    [
        (["000000", "000001", "000002"], None),
        (["0000000000", "0000000010", "0000000020"], None),
        (["100000000", "100000001", "100000002"], None),
        (["v1.2", "v1.3", "v1.4"], None),
        (["12.300000", "12.400000", "12.500000"], 0.1),
        (["326_423283736", "326_623283736", "326_823283736"], 0.2),
        (["0", "100000000", "200000000", "300000000"], 0.1),
        (["1700000000_0", "1700000000_50000000", "1700000000_100000000", "1700000000_150000000"], 0.05),
        (["1700000000-900000000", "1700000001-000000000", "1700000001-100000000"], 0.1),
        (["a_1700000000_900", "a_1700000001_000", "a_1700000001_100"], 0.1),
        (["20230115123045100", "20230115123045300", "20230115123045500"], 0.2),
        (["2023-01-15-12-30-59_500", "2023-01-15-12-31-00_000", "2023-01-15-12-31-00_500"], 0.5),
        (["20230115_123059", "20230115_123100", "20230115_123101"], 1.0),
        (["1700000000_001", "1700000000_002", "1700000000_003"], None),
        (["1700000000_9", "1700000000_10", "1700000000_11"], None),
        (["20231315123045100", "20231315123045200", "20231315123045300"], None),
    ],
)
def test_counters_dates_and_decimals_in_names(tmp_path: Path, names: list[str], step: float | None):
    write_clouds(tmp_path, names)
    with open_recording(tmp_path) as recording:
        assert len(recording.sweep_times) == len(names)
        np.testing.assert_allclose(np.diff(recording.sweep_times), step or 0.1, atol=1e-6)
        assert any("0.1 s apart" in text for text in recording.problems) == (step is None)


@pytest.mark.parametrize("unit", [1, 10**3, 10**6, 10**9])
@pytest.mark.parametrize("start", STARTS)
def test_the_unit_of_a_text_of_times_is_found(tmp_path: Path, start: str, unit: int):
    times = [STARTS[start] * unit + round(0.1 * unit * k) if unit > 1 else STARTS[start] + 0.1 * k for k in range(6)]
    (tmp_path / "times.txt").write_text("".join(f"{time}\n" for time in times))
    _, stamps, notice = order_clouds([Path(f"{k}.npy") for k in range(6)], [tmp_path])
    np.testing.assert_allclose(1e-9 * np.diff(stamps), 0.1, atol=1e-6)
    assert "times.txt" in notice


def test_stamps_keep_nanoseconds():
    values = [Decimal("1700000000.123456789"), Decimal("1700000000.223456789")]
    clock = find_clock(values)
    assert clock is not None and clock.stamp(values[0]) == 1_700_000_000_123_456_789


def test_poses_count_from_the_same_start_as_the_names(tmp_path: Path):
    write_clouds(tmp_path, [f"{251_370_000 + 100 * k}" for k in range(6)])
    rows = [f"{251_369.9 + 0.1 * k:.3f} {0.2 * (k - 1)} 0 0 0 0 0 1\n" for k in range(9)]
    (tmp_path / "poses.txt").write_text("".join(rows))
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None and len(recording.sweep_times) == 6
        position = recording.poses.interpolate(0.3).position + recording.poses.offset
        np.testing.assert_allclose(position, [0.6, 0, 0], atol=1e-6)


def test_the_only_folder_of_clouds_below_is_opened_and_of_several_one_must_be_chosen(tmp_path: Path):
    write_clouds(tmp_path / "sequences" / "07" / "velodyne", ["000003", "000004"])
    (tmp_path / "poses").mkdir()
    matrices = [np.hstack([np.eye(3), [[2.0 * k], [0], [0]]]).reshape(-1) for k in range(9)]
    np.savetxt(tmp_path / "poses" / "07.txt", matrices)
    with open_recording(tmp_path) as recording:
        assert recording.poses is not None
        np.testing.assert_allclose(recording.poses.positions[:, 0] + recording.poses.offset[0], [6, 8])
        assert any("sequences/07/velodyne" in text for text in recording.problems)
    write_clouds(tmp_path / "sequences" / "08" / "velodyne", ["000003"])
    with pytest.raises(UserError, match="choose one of sequences/07/velodyne, sequences/08/velodyne"):
        open_recording(tmp_path)


@pytest.mark.parametrize("period", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("name", ["time", "timestamp"])
def test_times_of_points_from_0_to_1_are_shares_of_a_sweep(tmp_path: Path, period: float, name: str):
    for k in range(4):
        rows = np.zeros(len(WALL), [("x", "f4"), ("y", "f4"), ("z", "f4"), (name, "f8")])
        rows["x"], rows["y"], rows["z"] = WALL.T
        rows[name] = np.linspace(0, 1, len(WALL), endpoint=False)
        np.save(tmp_path / f"{1_700_000_000 + period * k:.3f}.npy", rows)
    with open_recording(tmp_path) as recording:
        times = recording.sweep(1).point_times
        assert times is not None and times.max() == pytest.approx(period, rel=0.01)
        assert any("shares of a sweep" in text for text in recording.problems)


def test_sweeps_that_last_a_second_have_times_in_seconds(tmp_path: Path):
    for k in range(4):
        rows = np.zeros(len(WALL), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("time", "f4")])
        rows["x"], rows["y"], rows["z"] = WALL.T
        rows["time"] = np.linspace(0, 1, len(WALL), endpoint=False)
        np.save(tmp_path / f"{1_700_000_000 + k}.000.npy", rows)
    with open_recording(tmp_path) as recording:
        times = recording.sweep(1).point_times
        assert times is not None and times.max() == pytest.approx(1.0, rel=0.01)
