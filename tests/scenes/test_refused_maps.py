"""Maps and meshes that are damaged, truncated or too large are refused."""

import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from aero_viz.errors import UserError
from aero_viz.scenes.map_files import read_mesh, read_points
from tests.scenes.map_contents import POINTS, las, pcd, ply

DAMAGED = [
    ("m.pcd", b"hello", "no PCD header"),
    ("m.pcd", pcd("binary")[:-2000], "truncated: its header declares 500 points, and it holds 40"),
    ("m.pcd", pcd("ascii")[:-300], "row 496 does not have 3 numbers"),
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
    ("m.las", b"LASF", "its header has 4 bytes of at least 227"),
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
    "records": np.zeros(4, [("x", "f4"), ("y", "f4"), ("height", "f4")]),
    "records of texts": np.zeros(4, [("x", "U1"), ("y", "f4"), ("z", "f4")]),
    "records of objects": np.zeros(4, [("x", "O"), ("y", "f4"), ("z", "f4")]),
    "no number": np.array(1.0),
}


@pytest.mark.parametrize("name", NPY)
def test_an_npy_file_of_anything_but_points_is_refused(tmp_path, name):
    np.save(tmp_path / "m.npy", NPY[name])
    refusal(tmp_path / "m.npy")


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
