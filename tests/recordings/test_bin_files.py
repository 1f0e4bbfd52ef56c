"""The layout of .bin files, which have no header."""

from pathlib import Path

import bags
import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording


def room(count: int, seed: int) -> np.ndarray:
    """Return points on the walls and the ground of a room, in random order."""
    random = np.random.default_rng(seed)
    points = random.uniform([-12, -8, -1.5], [12, 8, 4], (count, 3))
    walls = random.integers(0, 3, count)
    points[walls == 0, 0], points[walls == 1, 1], points[walls == 2, 2] = 12, -8, -1.5
    return points


def extra_columns(count: int) -> list[np.ndarray]:
    """Return intensities, rings, times [s], reflectivities and labels."""
    random = np.random.default_rng(7)
    numbers = np.arange(count)
    return [
        random.uniform(0, 1, count),
        numbers % 16,
        0.1 * numbers / count,
        random.integers(0, 255, count),
        0 * numbers,
    ]


LAYOUTS = [(columns, "<f4") for columns in (3, 4, 5, 6, 7, 8)] + [(columns, "<f8") for columns in (3, 4, 5, 6)]


@pytest.mark.parametrize("scene", ["room", "wall", "forest"])
@pytest.mark.parametrize(("columns", "kind"), LAYOUTS)
@pytest.mark.parametrize("count", [840, 901])
def test_the_columns_of_a_bin_are_found(tmp_path: Path, scene: str, columns: int, kind: str, count: int):
    clouds = []
    for k in range(3):
        if scene == "room":
            points = room(count, k)
        elif scene == "wall":
            points = bags.wall(count, seed=k)
        else:
            angle, height = np.random.default_rng(k).uniform([0, -2], [6.283, 2], (count, 2)).T
            points = np.column_stack([15 * np.cos(angle), 15 * np.sin(angle), height])
        clouds.append(points)
        np.column_stack([points, *extra_columns(count)[: columns - 3]]).astype(kind).tofile(tmp_path / f"{k}.bin")
    with open_recording(tmp_path) as recording:
        for k, cloud in enumerate(clouds):
            np.testing.assert_allclose(recording.sweep(k).points, cloud, atol=1e-4)
        assert any(f"rows of {columns} numbers, float{8 * int(kind[2])}, " in text for text in recording.problems)


def test_one_layout_holds_for_a_folder_in_which_sizes_fit_several(tmp_path: Path):
    for k, count in enumerate([900, 901, 904, 905]):
        table = np.column_stack([room(count, k), np.full(count, 30.0), np.linspace(0, 0.1, count)])
        table.astype("<f4").tofile(tmp_path / f"{k}.bin")
    with open_recording(tmp_path) as recording:
        for k, count in enumerate([900, 901, 904, 905]):
            np.testing.assert_allclose(recording.sweep(k).points, room(count, k), atol=1e-4)


def test_a_truncated_bin_is_a_damaged_sweep(tmp_path: Path):
    for k in range(12):
        np.column_stack([room(500, k), np.ones(500)]).astype("<f4").tofile(tmp_path / f"{k}.bin")
    (tmp_path / "7.bin").write_bytes((tmp_path / "7.bin").read_bytes()[:-6])
    with open_recording(tmp_path) as recording:
        assert len(recording.sweep(6).points) == 500 and not len(recording.sweep(7).points)
        assert recording.damaged_sweeps == {7}


def test_sizes_that_fit_no_layout_are_refused(tmp_path: Path):
    (tmp_path / "a.bin").write_bytes(bytes(11))
    with pytest.raises(UserError, match=r"11 bytes, .* are no rows that start with x, y, z"):
        open_recording(tmp_path)


def scan(count: int, *, wall: float = 8.0, lasers: tuple[float, ...] = (-15, 1, -13, 3, -11, 5, -9, 7)) -> np.ndarray:
    """Return the points of a street in the order of a spinning LiDAR, whose lasers look down and up in turn."""
    elevation = np.radians(np.resize(lasers, count))
    azimuth = np.repeat(np.linspace(0, 2 * np.pi, -(-count // len(lasers)), endpoint=False), len(lasers))[:count]
    ranges = wall / np.maximum(np.abs(np.sin(azimuth)), 0.1) / np.cos(elevation)
    ranges = np.minimum(ranges, 1.8 / np.maximum(-np.sin(elevation), 1e-3) * (elevation < 0) + 1e3 * (elevation >= 0))
    ranges *= 1 + np.random.default_rng(1).normal(0, 0.002, count)
    flat = ranges * np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation)])


def ring_of_simulated_walls(count: int) -> np.ndarray:
    """Return points of a room without noise, many of which have coordinates of exactly zero or about 1e-16."""
    azimuth = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    table = np.column_stack(
        [np.resize(azimuth, count), np.radians(np.repeat(np.arange(-25, 25), count // 50 + 1))[:count]]
    )
    ranges = np.minimum(
        6 / np.maximum(np.abs(np.cos(table[:, 0])), 1e-9), 4 / np.maximum(np.abs(np.sin(table[:, 0])), 1e-9)
    )
    return np.column_stack([ranges * np.cos(table[:, 0]), ranges * np.sin(table[:, 0]), ranges * np.tan(table[:, 1])])


def depth_image(count: int) -> np.ndarray:
    """Return the points of a depth camera within 0.5 to 4 m: x right, y ahead, z up."""
    ahead = 2 + np.sin(np.arange(count) / 300)
    return np.column_stack([ahead * np.linspace(-1, 1, count), ahead, ahead * np.sin(np.arange(count) / 40)])


def millimetres(points: np.ndarray) -> np.ndarray:
    return np.round(points, 3)


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("columns", [3, 4, 5, 6, 7])
@pytest.mark.parametrize("cloud", ["street", "far street", "walls", "depth", "rounded", "with holes"])
def test_the_columns_of_one_scan_in_the_order_of_measurement_are_found(
    tmp_path: Path, cloud: str, columns: int, kind: str
):
    count = 5040
    points = {
        "street": scan(count),
        "far street": scan(count, wall=60.0),
        "walls": ring_of_simulated_walls(count),
        "depth": depth_image(count),
        "rounded": millimetres(scan(count)),
        "with holes": np.where(np.arange(count)[:, None] % 3 == 0, 0.0, scan(count)),
    }[cloud]
    table = np.column_stack([points, *extra_columns(count)[: columns - 3]]).astype(kind)
    table.tofile(tmp_path / "a.bin")
    with open_recording(tmp_path / "a.bin") as recording:
        kept = table[(table[:, :3] != 0).any(axis=1), :3].astype("f4")
        np.testing.assert_array_equal(recording.sweep(0).points, kept)


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("extra", ["colours", "normals", "outward normals", "nothing but zeros", "range"])
def test_columns_that_look_like_coordinates_belong_to_the_row(tmp_path: Path, extra: str, kind: str):
    points = scan(5040)
    more = {
        "colours": np.random.default_rng(3).integers(0, 255, points.shape) / 255,
        "normals": -points / np.linalg.norm(points, axis=1, keepdims=True),
        "outward normals": points / np.linalg.norm(points, axis=1, keepdims=True),
        "nothing but zeros": np.zeros(points.shape),
        "range": np.column_stack([np.linalg.norm(points, axis=1), np.arange(5040) % 8, np.arange(5040) / 5e4]),
    }[extra]
    table = np.column_stack([points, more]).astype(kind)
    table.tofile(tmp_path / "a.bin")
    with open_recording(tmp_path / "a.bin") as recording:
        np.testing.assert_array_equal(recording.sweep(0).points, table[:, :3].astype("f4"))


def test_columns_may_be_named(tmp_path: Path):
    points = scan(120)
    rows = np.zeros(120, [("xyz", "<f4", 3), ("i", "<f4"), ("ring", "<u2"), ("t", "<f4")])
    rows["xyz"], rows["i"], rows["ring"], rows["t"] = points, 30.0, np.arange(120) % 8, np.linspace(0, 0.1, 120)
    rows.tofile(tmp_path / "a.bin")
    with open_recording(tmp_path / "a.bin", columns="4f4,u2,f4") as recording:
        np.testing.assert_allclose(recording.sweep(0).points, points, atol=1e-5)
        assert any("f4,f4,f4,f4,u2,f4" in text and "--columns says" in text for text in recording.problems)
    for wrong in ("", "2", "f4", "u2,u2,u2", "4x", "9999", "f2,f2,f2"):
        with pytest.raises(UserError, match="--columns"):
            open_recording(tmp_path / "a.bin", columns=wrong)


def test_columns_without_bin_files_are_refused(tmp_path: Path):
    bags.write_mcap(tmp_path / "a.mcap", bags.drive(2))
    with pytest.raises(UserError, match=r"--columns .* has none; leave it out"):
        open_recording(tmp_path / "a.mcap", columns="4")


@pytest.mark.parametrize("kind", ["<f4", "<f8"])
@pytest.mark.parametrize("more", [1, 5, 6, 7, 10, 14, 17])
def test_rows_with_other_numbers_behind_x_y_z_are_read(tmp_path: Path, more: int, kind: str):
    points = scan(5040).astype(kind)
    random = np.random.default_rng(0).integers(0, 256, (5040, more), np.uint8)
    np.hstack([points.view(np.uint8), random]).tofile(tmp_path / "a.bin")
    with open_recording(tmp_path / "a.bin") as recording:
        np.testing.assert_array_equal(recording.sweep(0).points, points.astype("f4"))
        size = points.itemsize * 3 + more
        assert any(f"rows of {size} bytes" in text for text in recording.problems)


@pytest.mark.parametrize("kind", ["i2", "i4", "u2", "u1", "f2"])
def test_rows_of_another_kind_of_numbers_are_refused(tmp_path: Path, kind: str):
    if kind == "u1":
        np.random.default_rng(0).integers(0, 256, (5040, 12), np.uint8).tofile(tmp_path / "a.bin")
    else:
        (np.abs(scan(5040)) * (1 if kind == "f2" else 1000)).clip(0, 30_000).astype(kind).tofile(tmp_path / "a.bin")
    with pytest.raises(UserError, match="--columns"):
        open_recording(tmp_path / "a.bin")


@pytest.mark.parametrize(("pattern", "columns"), [("*kitti_raw*", 4), ("*sunrgbd*", 6), ("*simulated_room*", 4)])
def test_the_columns_of_public_files_are_found(shared_cases: Path, pattern: str, columns: int):
    path = next((shared_cases / "recordings").glob(f"{pattern}.bin"))
    with open_recording(path) as recording:
        assert any(f"rows of {columns} numbers, float32" in text for text in recording.problems)
