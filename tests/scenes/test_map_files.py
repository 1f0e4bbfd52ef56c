import io
import json
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import captures
import laspy
import numpy as np
import open3d
import pytest
import trimesh

from aero_viz.errors import UserError
from aero_viz.scenes.map_files import read_mesh, read_points

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-20.0, 20.0, (500, 3)).astype(np.float32)
POINTS[:200] = np.round(POINTS[:200])  # something to compress


def pack_lzf(data: bytes) -> bytes:
    """Compress with LZF: the longest match at the last occurrence of the next three bytes, else a literal."""
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


def pcd(form: str, points=POINTS, size: int = 4) -> bytes:
    """A PCD file with x, y of `size` bytes and z of 8 among other fields, one of two values and two of equal names."""
    real = f"<f{size}"
    record = np.dtype([("a", "<u2"), ("x", real), ("y", real), ("_", "u1", (2,)), ("z", "<f8"), ("__", "u1")])
    table = np.zeros(len(points), dtype=record)
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    table["a"], table["_"] = 7, 9
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS a x y _ z _\n"
        f"SIZE 2 {size} {size} 1 8 1\nTYPE U F F U F U\nCOUNT 1 1 1 2 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT -0.15 -0.2 -0.06 0.99983 -0.0084 0.00013 0.0163\n"
        f"POINTS {len(points)}\nDATA {form}\n"
    ).encode()
    if form == "ascii":
        rows = [f"7 {x!r} {y!r} 9 9 {z!r} 0" for x, y, z in points.astype(float).tolist()]
        return header + "\n".join(rows).encode() + b"\n"
    if form == "binary":
        return header + table.tobytes()
    plain = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in record.names or ())
    packed = pack_lzf(plain)
    return header + struct.pack("<II", len(packed), len(plain)) + packed


def las(version: str, path: Path, points=POINTS, offset=(100.0, 200.0, -5.0)) -> bytes:
    """A LAS or LAZ file, written by laspy."""
    header = laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version)
    header.scales, header.offsets = np.array([0.001, 0.001, 0.01]), np.array(offset)
    content = laspy.LasData(header)
    content.x, content.y, content.z = points.T
    content.write(str(path))
    return path.read_bytes()


def ply(encoding: str, points=POINTS) -> bytes:
    buffer = io.BytesIO()
    trimesh.PointCloud(points).export(buffer, file_type="ply", encoding=encoding)
    return buffer.getvalue()


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


DAMAGED = [
    ("m.pcd", b"hello", "no PCD header"),
    ("m.pcd", pcd("binary")[:-2000], "truncated: its header declares 500 points, and it holds 40"),
    ("m.pcd", pcd("ascii")[:-300], "at row 496 with 3 columns"),
    ("m.pcd", pcd("ascii").rsplit(b"\n", 9)[0], "truncated: its header declares 500 points, and it holds 492"),
    ("m.pcd", pcd("binary").replace(b" 500", b" 1000000000000"), "truncated"),
    ("m.pcd", pcd("binary_compressed").replace(b"POINTS 500", b"POINTS 1000000000000"), "compressed data"),
    ("m.pcd", pcd("binary").replace(b"DATA binary", b"DATA zipped"), "zipped"),
    ("m.pcd", pcd("binary").replace(b"FIELDS a x y _ z _", b"FIELDS a x y _ w _"), "no field z"),
    ("m.pcd", pcd("binary_compressed")[:-300], "compressed data"),
    ("m.pcd", pcd("ascii", POINTS[:0]), "no finite points"),
    ("m.ply", b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n", "truncated"),
    ("m.ply", ply("ascii")[:-1000], "truncated: its header declares 500 points"),
    ("m.ply", ply("binary")[:-1000], "truncated: its header declares 500 points, and it holds 416"),
    ("m.ply", ply("binary").replace(b"vertex 500", b"vertex 1000000000000"), "truncated"),
    ("m.ply", ply("binary").replace(b"float z", b"float q"), "no property z"),
    ("m.ply", ply("binary").replace(b"property float x", b"property list uchar int x"), "is a list"),
    ("m.ply", b"PK", "does not start with a PLY header"),
    ("m.las", b"LASF", "small"),
    ("m.las", b"PCDF" * 100, "does not start with LASF"),
    ("m.npy", b"\x93NUMPY", "m.npy"),
    ("m.pts", b"5\n1 2 3\n", "truncated: its header declares 5 points, and it holds 1"),
    ("m.obj", b"1 2 3", "must end in one of .pcd"),
]


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        read_points(path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    return message


@pytest.mark.parametrize(("name", "content", "expected"), DAMAGED)
def test_a_damaged_file_is_refused_in_one_sentence(tmp_path, name, content, expected):
    path = tmp_path / name
    path.write_bytes(content)
    assert expected in refusal(path)


def test_a_las_map_in_feet_becomes_metres(tmp_path: Path):
    path = tmp_path / "feet.las"
    captures.write_las(path, POINTS / 0.3048, keys={3076: 9002})
    np.testing.assert_allclose(read_points(path), POINTS, atol=1e-3)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_a_truncated_las_file_is_refused(tmp_path, version, suffix):
    path = tmp_path / f"m.{suffix}"
    content = las(version, path)
    for length in (len(content) - 40, len(content) // 2):
        path.write_bytes(content[:length])
        refusal(path)


def test_a_las_header_that_declares_too_many_points_is_refused(tmp_path):
    path = tmp_path / "m.las"
    content = bytearray(las("1.4", path))
    struct.pack_into("<Q", content, 247, 10**12)
    path.write_bytes(content)
    assert "declares 1000000000000 points, and it holds" in refusal(path)


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_las_file_that_declares_too_many_records_or_chunks_is_refused(tmp_path, suffix):
    path = tmp_path / f"m.{suffix}"
    content = las("1.2", path)
    for offset in (100, *([struct.unpack_from("<q", content, struct.unpack_from("<I", content, 96)[0])[0] + 4]
                          if suffix == "laz" else [])):  # fmt: skip
        damaged = bytearray(content)
        struct.pack_into("<I", damaged, offset, 0xFFFFFFFF)
        path.write_bytes(damaged)
        assert "damaged" in refusal(path)


def test_an_npy_header_that_declares_too_many_points_is_refused(tmp_path):
    path = tmp_path / "m.npy"
    np.save(path, POINTS.astype(np.float64))
    path.write_bytes(path.read_bytes().replace(b"(500, 3), }   ", b"(10000000000, 3), }"[:14]))
    refusal(path)


NPY = {
    "empty": np.zeros((0, 3)),
    "flat": np.zeros(9),
    "two columns": np.zeros((4, 2)),
    "texts": np.full((4, 3), "a"),
    "dates": np.zeros((4, 3), "datetime64[s]"),
    "objects": np.full((4, 3), None),
    "records": np.zeros(4, [("x", "f4"), ("y", "f4"), ("z", "f4")]),
    "no number": np.array(1.0),
}


@pytest.mark.parametrize("name", NPY)
def test_an_npy_file_of_anything_but_points_is_refused(tmp_path, name):
    np.save(tmp_path / "m.npy", NPY[name])
    refusal(tmp_path / "m.npy")


def test_npy_in_column_order(tmp_path):
    np.save(tmp_path / "m.npy", np.asfortranarray(POINTS))
    np.testing.assert_array_equal(read_points(tmp_path / "m.npy"), POINTS)


BOX = trimesh.creation.box((2.0, 3.0, 4.0)).subdivide()
MESHES = {
    "off": lambda: BOX.export(file_type="off"),
    "stl": lambda: BOX.export(file_type="stl"),
    "stl text": lambda: BOX.export(file_type="stl_ascii"),
    "ply": lambda: BOX.export(file_type="ply"),
    "ply text": lambda: BOX.export(file_type="ply", encoding="ascii"),
    "glb": lambda: BOX.export(file_type="glb"),
    "obj": lambda: f"# Vertices: {len(BOX.vertices)}\n# Faces: {len(BOX.faces)}\n" + str(BOX.export(file_type="obj")),
}


def as_bytes(content: Any) -> bytes:
    return content.encode() if isinstance(content, str) else bytes(content)


@pytest.mark.parametrize("name", MESHES)
def test_a_mesh_that_is_cut_is_refused(tmp_path, name):
    content, path = as_bytes(MESHES[name]()), tmp_path / f"m.{name.split()[0]}"
    path.write_bytes(content)
    assert len(read_mesh(path)) == len(BOX.faces)
    for length in (*np.linspace(0, len(content.rstrip()) - 6, 4).astype(int), content.rstrip().rfind(b"\n")):
        path.write_bytes(content[:length])
        with pytest.raises(UserError, match=path.name):
            read_mesh(path)


@pytest.mark.parametrize("suffix", ["xyz", "pts", "pcd"])
def test_a_table_that_is_cut_within_its_last_row_is_refused(tmp_path, suffix):
    path = tmp_path / f"m.{suffix}"
    first = {"xyz": b"", "pts": b"4\n", "pcd": pcd("ascii", POINTS[:4]).split(b"ascii\n")[0] + b"ascii\n"}[suffix]
    rows = b"7 1.5 2.5 9 9 3.5 0\n" * 4 if suffix == "pcd" else b"1.5 2.5 3.5 4 5\n" * 4
    path.write_bytes(first + rows[:-3])
    assert "truncated" in refusal(path)


def test_no_other_file_is_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "m.obj").write_text("mtllib pipe\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    assert len(read_mesh(tmp_path / "m.obj")) == 1
    content = as_bytes(MESHES["glb"]())
    tree = json.loads(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])
    tree["buffers"] = [{"byteLength": 10, "uri": "../../etc/passwd"}]
    text = json.dumps(tree).encode()
    (tmp_path / "m.glb").write_bytes(struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text)
    with pytest.raises(UserError, match=r"m\.glb.*no other file is opened"):
        read_mesh(tmp_path / "m.glb")


def test_a_decoder_that_crashes_is_survived(tmp_path):
    path, content = tmp_path / "m.laz", las("1.4", tmp_path / "m.laz")
    random = np.random.default_rng(3)
    start = struct.unpack_from("<I", content, 96)[0]
    for _ in range(6):
        damaged = bytearray(content)
        for at in random.integers(start, len(content), 12):
            damaged[at] = random.integers(256)
        path.write_bytes(damaged)
        try:
            assert len(read_points(path)) == len(POINTS)
        except UserError as error:
            assert "m.laz" in str(error) and "\n" not in str(error)


def test_a_missing_file_and_a_pipe_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.pcd: No such file"):
        read_points(tmp_path / "nowhere.pcd")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.obj")
        with pytest.raises(UserError, match="not a regular file"):
            read_mesh(tmp_path / "pipe.obj")
