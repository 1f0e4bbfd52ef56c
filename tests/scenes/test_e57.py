"""Points of E57 files, which pye57 writes here."""

from pathlib import Path

import numpy as np
import pye57
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import open_recording
from aero_viz.scenes import load_map
from aero_viz.scenes.decoding_process import DecodingProcess

POINTS = np.random.default_rng(0).uniform(-20.0, 20.0, (500, 3))


def write(path: Path, *scans: np.ndarray, states: np.ndarray | None = None, **pose: np.ndarray) -> None:
    """Write scans, each of x, y, z in its own frame."""
    with pye57.E57(str(path), mode="w") as file:
        for scan in scans:
            fields = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), np.ascontiguousarray(scan.T), strict=True))
            if states is not None:
                fields["cartesianInvalidState"] = states
            file.write_scan_raw(fields, **pose)


def read(path: Path) -> np.ndarray:
    with DecodingProcess() as process:
        points, times = process.decode_points(path)
    assert times is None
    return points


def test_scans_are_joined(tmp_path: Path):
    write(tmp_path / "a.e57", POINTS, POINTS[:100] + 1.0)
    np.testing.assert_allclose(read(tmp_path / "a.e57"), np.concatenate([POINTS, POINTS[:100] + 1.0]), atol=1e-3)


def test_scans_are_turned_and_moved_by_their_poses(tmp_path: Path):
    half = np.sqrt(0.5)
    write(tmp_path / "a.e57", POINTS, rotation=np.array([half, 0.0, 0.0, half]), translation=np.array([1.0, 2.0, 3.0]))
    turned = np.column_stack([-POINTS[:, 1], POINTS[:, 0], POINTS[:, 2]]) + np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(read(tmp_path / "a.e57"), turned, atol=1e-3)


def test_points_that_are_marked_invalid_are_left_out(tmp_path: Path):
    invalid = np.zeros(500, np.int8)
    invalid[::5] = 2
    write(tmp_path / "a.e57", POINTS, states=invalid)
    np.testing.assert_allclose(read(tmp_path / "a.e57"), POINTS[invalid == 0], atol=1e-3)


def test_a_scan_is_a_world_and_a_recording(tmp_path: Path):
    write(tmp_path / "a.e57", POINTS)
    assert len(load_map(tmp_path / "a.e57").boxes) > 100
    recording = open_recording(tmp_path / "a.e57")
    assert len(recording.sweep_times) == 1
    recording.close()


@pytest.mark.parametrize("cut", [49, 2000, 6000])
def test_a_damaged_file_is_refused_by_name(tmp_path: Path, cut: int):
    write(tmp_path / "a.e57", POINTS)
    content = bytearray((tmp_path / "a.e57").read_bytes())
    for name, damaged in (("cut.e57", content[:-cut]), ("bit.e57", content[:cut] + b"!" + content[cut + 1 :])):
        (tmp_path / name).write_bytes(damaged)
        with pytest.raises(UserError, match=name):
            load_map(tmp_path / name)
