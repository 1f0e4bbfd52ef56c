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
        said = any("read as rows of" in problem for problem in recording.problems)
        assert said == ((columns, kind) not in ((4, "<f4"), (5, "<f4")))


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
    (tmp_path / "a.bin").write_bytes(bytes(17))
    with pytest.raises(UserError, match="17 bytes are not rows of 3 to 8 numbers"):
        open_recording(tmp_path)
