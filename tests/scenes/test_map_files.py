from __future__ import annotations

import struct
import sys

import numpy as np
import pytest
import trimesh

from aero_viz.errors import UserError
from aero_viz.scenes.map_files import read_points

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-20.0, 20.0, (500, 3)).astype(np.float32)
POINTS[:200] = np.round(POINTS[:200])  # something to compress


def pack_lzf(data: bytes) -> bytes:
    """A plain LZF compressor: the longest match among the last places of the same three bytes, else a literal."""
    out, literals, seen, i = bytearray(), bytearray(), {}, 0

    def flush():
        for k in range(0, len(literals), 32):
            part = literals[k : k + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literals.clear()

    while i < len(data):
        start = seen.get(data[i : i + 3], -1)
        length = 0
        if start >= 0 and i - start <= 8192:
            while length < 264 and i + length < len(data) and data[start + length] == data[i + length]:
                length += 1
        seen[data[i : i + 3]] = i
        if length < 3:
            literals.append(data[i])
            i += 1
            continue
        flush()
        back, code = i - start - 1, length - 2
        out.append((min(code, 7) << 5) | (back >> 8))
        if code >= 7:
            out.append(code - 7)
        out.append(back & 255)
        i += length
    flush()
    return bytes(out)


def pcd(form: str, points=POINTS, extra: bytes = b"") -> bytes:
    """x, y, z between other fields, one of them of two values and padding with a repeated name."""
    record = np.dtype([("a", "<u2"), ("x", "<f4"), ("y", "<f4"), ("_", "u1", (2,)), ("z", "<f8"), ("__", "u1")])
    table = np.zeros(len(points), dtype=record)
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    table["a"], table["_"] = 7, 9
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS a x y _ z _\nSIZE 2 4 4 1 8 1\n"
        f"TYPE U F F U F U\nCOUNT 1 1 1 2 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(points)}\nDATA {form}\n"
    ).encode()
    if form == "ascii":
        rows = [f"7 {x!r} {y!r} 9 9 {z!r} 0" for x, y, z in points.astype(float).tolist()]
        return header + "\n".join(rows).encode() + b"\n"
    if form == "binary":
        return header + table.tobytes() + extra
    plain = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in record.names or ())
    packed = pack_lzf(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


def las(version: int, points=POINTS, compressed: bool = False) -> bytes:
    header = bytearray(375)
    header[:4], header[24], header[25] = b"LASF", 1, version
    kind, length = (6, 30) if version == 4 else (0, 20)
    struct.pack_into("<IBHI", header, 96, 375, kind | (0x80 if compressed else 0), length, len(points))
    struct.pack_into("<6d", header, 131, 0.001, 0.001, 0.01, 100.0, 200.0, -5.0)
    if version == 4:
        struct.pack_into("<I", header, 107, 0)
        struct.pack_into("<Q", header, 247, len(points))
    scaled = np.rint((points - [100.0, 200.0, -5.0]) / [0.001, 0.001, 0.01]).astype("<i4")
    records = np.zeros((len(points), length), dtype=np.uint8)
    records[:, :12] = scaled.view(np.uint8).reshape(len(points), 12)
    return bytes(header) + records.tobytes()


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path, form):
    path = tmp_path / "m.pcd"
    path.write_bytes(pcd(form))
    np.testing.assert_array_equal(read_points(path), POINTS)


def test_compression_of_long_and_overlapping_copies(tmp_path):
    constant = np.zeros((4000, 3), dtype=np.float32)
    path = tmp_path / "m.pcd"
    content = pcd("binary_compressed", constant)
    assert len(content) < 4000  # so that copies were written
    path.write_bytes(content)
    np.testing.assert_array_equal(read_points(path), constant)


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply(tmp_path, encoding):
    path = tmp_path / "m.ply"
    trimesh.PointCloud(POINTS).export(path, encoding=encoding)
    np.testing.assert_allclose(read_points(path), POINTS, atol=1e-5)


@pytest.mark.parametrize("version", [2, 4])
def test_las(tmp_path, version):
    path = tmp_path / "m.las"
    path.write_bytes(las(version))
    np.testing.assert_allclose(read_points(path), POINTS, atol=0.00501)


def test_npy_with_more_columns_and_points_that_are_not_finite(tmp_path):
    table = np.column_stack([POINTS, np.ones(len(POINTS))])
    table[3, 1] = np.nan
    np.save(tmp_path / "m.npy", table)
    np.testing.assert_array_equal(read_points(tmp_path / "m.npy"), np.delete(POINTS, 3, axis=0))


def test_laz_without_its_library_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    path = tmp_path / "m.laz"
    path.write_bytes(las(2, compressed=True))
    with pytest.raises(UserError, match=r"pip install 'aero-viz\[maps\]'"):
        read_points(path)


def test_text_without_its_library_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    path = tmp_path / "m.xyz"
    path.write_text("1 2 3\n")
    with pytest.raises(UserError, match=r"needs open3d.*pip install 'aero-viz\[maps\]'"):
        read_points(path)


def test_text_is_read_where_its_library_loads(tmp_path):
    try:
        import open3d  # noqa: F401  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:
        pytest.skip(f"open3d does not load here, XYZ files were not tried: {error}")
    path = tmp_path / "m.xyz"
    path.write_text("1 2 3\n4 5 6\n")
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("m.pcd", b"hello", "no PCD header"),
        ("m.pcd", pcd("binary")[:-2000], "buffer is smaller"),
        ("m.pcd", pcd("binary").replace(b"DATA binary", b"DATA zipped"), "zipped"),
        ("m.pcd", pcd("binary").replace(b"FIELDS a x y _ z _", b"FIELDS a x y _ w _"), "no field z"),
        ("m.pcd", pcd("binary_compressed")[:-300], "compressed data"),
        ("m.pcd", pcd("ascii", POINTS[:0]), "no finite points"),
        ("m.ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n", "no map|no vertices"),
        ("m.ply", b"PK", "does not start with ply"),
        ("m.las", b"LASF", "unpack"),
        ("m.las", las(2)[:-40], "cut off"),
        ("m.las", b"PCDF" * 100, "does not start with LASF"),
        ("m.npy", b"\x93NUMPY", "no map"),
        ("m.obj", b"1 2 3", "must end in one of .pcd"),
    ],
)
def test_damaged_files_are_named_in_one_sentence(tmp_path, name, content, expected):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UserError, match=expected) as caught:
        read_points(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.pcd: No such file"):
        read_points(tmp_path / "nowhere.pcd")
