"""Contents of map files, written byte by byte."""

import io
import struct
from pathlib import Path

import laspy
import numpy as np
import trimesh

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
