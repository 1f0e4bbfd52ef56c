"""Points and triangles of map files in every format, whole and malformed."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import captures
import numpy as np
import open3d
import pytest

from aero_viz.scenes.map_files import read_points
from tests.scenes.map_contents import POINTS, las, pcd, ply


@pytest.fixture
def cloud() -> Any:
    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS.astype(np.float64)))


@pytest.mark.parametrize("size", [4, 8])
@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path, form, size):
    path = tmp_path / "m.pcd"
    path.write_bytes(pcd(form, size=size))
    np.testing.assert_array_equal(read_points(path), POINTS)


PLAIN = (
    "# .PCD v.7 - Point Cloud Data file format\nVERSION .7\nFIELDS x y z intensity class\nSIZE 4 4 4 4 4\n"
    "TYPE F F F F F\nCOUNT 1 1 1 1 1\nWIDTH 500\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 500\nDATA binary\n"
)
MALFORMED = {
    "no line break before SIZE and WIDTH, as in livox_lane_detection": (
        "class\nSIZE",
        "classSIZE",
        "1\nWIDTH",
        "1WIDTH",
    ),
    "five fields of which four are described, as there": (
        "4 4 4 4 4",
        "4 4 4 4",
        "F F F F F",
        "F F F F",
        "1 1 1 1 1",
        "1 1 1 1",
    ),
    "Windows": ("\n", "\r\n"),
    "only POINTS is right": ("WIDTH 500", "WIDTH 1"),
    "only WIDTH is right": ("POINTS 500", "POINTS 0"),
    "no number of points": ("WIDTH 500\nHEIGHT 1\n", "", "POINTS 500\n", ""),
    "neither COUNT nor VIEWPOINT": ("COUNT 1 1 1 1 1\n", "", "VIEWPOINT 0 0 0 1 0 0 0\n", ""),
    "one size too many": ("4 4 4 4 4", "4 4 4 4 4 4"),
    "upper case": ("x y z", "X Y Z"),
    "no comment": ("# .PCD v.7 - Point Cloud Data file format\n", ""),
}


@pytest.mark.parametrize("form", ["ascii", "binary"])
@pytest.mark.parametrize("changes", MALFORMED.values(), ids=MALFORMED)
def test_a_malformed_header_of_pcd_is_read_by_what_fits_the_data(tmp_path, changes, form):
    header = PLAIN.replace("binary", form)
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        assert old in header
        header = header.replace(old, new)
    rows = np.column_stack([POINTS, np.ones((500, 2))]).astype("<f4")
    text = "".join(" ".join(map(repr, row)) + "\n" for row in rows.astype(float).tolist())
    path = tmp_path / "m.pcd"
    path.write_bytes(header.encode() + (text.encode() if form == "ascii" else rows.tobytes()))
    np.testing.assert_array_equal(read_points(path), POINTS)


@pytest.mark.parametrize("options", [{"write_ascii": True}, {}, {"compressed": True}])
@pytest.mark.parametrize("suffix", ["pcd", "ply"])
def test_files_of_open3d(tmp_path, cloud, suffix, options):
    path = tmp_path / f"m.{suffix}"
    assert open3d.io.write_point_cloud(path, cloud, **options)
    np.testing.assert_allclose(read_points(path), POINTS, atol=1e-4)  # its texts have six digits


def test_compression_of_long_and_overlapping_copies(tmp_path):
    constant = np.zeros((4000, 3), dtype=np.float32)
    path = tmp_path / "m.pcd"
    content = pcd("binary_compressed", constant)
    assert len(content) < 4000  # the file consists of copies
    path.write_bytes(content)
    np.testing.assert_array_equal(read_points(path), constant)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply(tmp_path, encoding):
    path = tmp_path / "m.ply"
    path.write_bytes(ply(encoding))
    np.testing.assert_allclose(read_points(path), POINTS, atol=1e-5)


def test_ply_of_another_byte_order_behind_another_element(tmp_path):
    header = "ply\nformat binary_big_endian 1.0\nelement camera 2\nproperty uchar id\nelement vertex 500\n"
    header += "property double Z\nproperty float X\nproperty float Y\nelement face 1\nproperty list uchar int v\n"
    rows = np.rec.fromarrays([POINTS[:, k].astype(code) for k, code in ((2, ">f8"), (0, ">f4"), (1, ">f4"))])
    (tmp_path / "m.ply").write_bytes(header.encode() + b"end_header\n\1\2" + rows.tobytes() + bytes(1))
    np.testing.assert_array_equal(read_points(tmp_path / "m.ply"), POINTS)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_las(tmp_path, version, suffix):
    path = tmp_path / f"m.{suffix}"
    las(version, path)
    np.testing.assert_allclose(read_points(path), POINTS, atol=0.00501)


def test_double_precision_of_geographic_coordinates(tmp_path):
    far = POINTS + np.array([500_000.0, 4_000_000.0, 300.0])
    (tmp_path / "m.pcd").write_bytes(pcd("binary", far, size=8))
    np.testing.assert_array_equal(read_points(tmp_path / "m.pcd"), far)
    las("1.4", tmp_path / "m.laz", far, offset=(500_000.0, 4_000_000.0, 0.0))
    np.testing.assert_allclose(read_points(tmp_path / "m.laz"), far, atol=0.00501)


def test_npy_with_more_columns_and_points_that_are_not_finite(tmp_path):
    table = np.column_stack([POINTS, np.ones(len(POINTS))])
    table[3, 1] = np.nan
    np.save(tmp_path / "m.npy", table)
    np.testing.assert_array_equal(read_points(tmp_path / "m.npy"), np.delete(POINTS, 3, axis=0))


@pytest.mark.parametrize(("suffix", "first"), [("xyz", ""), ("pts", "2\n")])
def test_text(tmp_path, suffix, first):
    path = tmp_path / f"m.{suffix}"
    path.write_text(first + "1 2 3\n4 5 6\n")
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3], [4, 5, 6]])


def test_the_real_map_loads_whole(shared_datasets):
    points = read_points(shared_datasets / "livox_mid40_surf.pcd")
    assert points.shape == (91_531, 3) and points.dtype == np.float64


def test_libraries_load_only_when_a_map_is_read():
    code = (
        "import sys; import aero_viz.cli, aero_viz.dashboard, aero_viz.flight; from aero_viz.catalog import load_world;"
        "load_world('forest'); print([name for name in ('open3d', 'laspy', 'trimesh.exchange') if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert result.stdout.split("\n")[-2] == "[]"


def test_a_las_map_in_feet_becomes_metres(tmp_path: Path):
    path = tmp_path / "feet.las"
    captures.write_las(path, POINTS / 0.3048, keys={3076: 9002})
    np.testing.assert_allclose(read_points(path), POINTS, atol=1e-3)


def test_npy_in_column_order(tmp_path):
    np.save(tmp_path / "m.npy", np.asfortranarray(POINTS))
    np.testing.assert_array_equal(read_points(tmp_path / "m.npy"), POINTS)
