"""Triangles from files, decoded by trimesh, which silently loads truncated files: declared counts are checked."""

from __future__ import annotations

import io
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import read_user_bytes
from aero_viz.scenes.decoder_checks import check_count, read_ply_header


class _NoOtherFiles:
    """Refuses the files that a mesh names when trimesh asks for them."""

    def get(self, name: str) -> bytes:
        raise ValueError(f"it needs the file {name[:80]!r}, and no other file is opened: export it as a single file")

    __getitem__ = get

    def namespaced(self, _: str) -> _NoOtherFiles:
        return self


def read_triangles(path: Path) -> NDArray[np.float64]:
    """Return the triangles of a file [n, 9] [m] without degenerate ones; raises an exception where it is damaged."""
    import trimesh

    content, suffix = read_user_bytes(path), path.suffix.lower()
    least = _CHECKS[suffix](content, path)
    resolver: Any = _NoOtherFiles()
    mesh: Any = trimesh.load(
        io.BytesIO(content), file_type=suffix[1:], resolver=resolver, force="mesh", process=False,
        skip_materials=True,
    )  # fmt: skip
    corners = np.asarray(mesh.triangles, dtype=np.float64)
    check_count(least, len(corners), "faces")
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return corners[area > 0.0].reshape(-1, 9)


# Each check raises ValueError for a file that is cut, and returns the least number of triangles that it must yield.


def _check_off(content: bytes, _: Path) -> int:
    lines = [line.split(b"#")[0].split() for line in content.splitlines()]
    lines = [line for line in lines if line]
    if not lines or not lines[0][0].endswith(b"OFF"):
        raise ValueError("it does not start with OFF")
    counts, rows = (lines[0][1:], lines[1:]) if len(lines[0]) > 1 else (lines[1] if len(lines) > 1 else [], lines[2:])
    if len(counts) < 2:
        raise ValueError("it is truncated: it lacks the numbers of its vertices and faces")
    vertices, faces = int(counts[0]), int(counts[1])
    check_count(vertices, len(rows), "vertices")
    whole = [row for row in rows[vertices : vertices + faces] if len(row) > int(row[0])]
    check_count(faces, len(whole), "faces")
    return faces


def _check_stl(content: bytes, _: Path) -> int:
    if len(content) >= 84 and len(content) == 84 + 50 * struct.unpack_from("<I", content, 80)[0]:
        return struct.unpack_from("<I", content, 80)[0]
    text = content.lower()
    if not text.lstrip().startswith(b"solid") or b"facet" not in text[:4096]:
        if len(content) < 84:
            raise ValueError("it is truncated: its header has 84 bytes")
        check_count(struct.unpack_from("<I", content, 80)[0], (len(content) - 84) // 50, "faces")
        raise ValueError("it is longer than its header declares")
    facets = len(re.findall(rb"\bfacet\s", text))
    check_count(facets, len(re.findall(rb"\bendfacet\b", text)), "faces")
    solids = len(re.findall(rb"^[ \t]*solid\b", text, re.MULTILINE))
    check_count(solids, len(re.findall(rb"^[ \t]*endsolid\b", text, re.MULTILINE)), "solids")
    return facets


def _check_glb(content: bytes, _: Path) -> int:
    if len(content) < 12 or content[:4] != b"glTF":
        raise ValueError("it does not start with glTF")
    check_count(struct.unpack_from("<I", content, 8)[0], len(content), "bytes") if len(content) < 1 << 25 else None
    return 0


def _check_obj(content: bytes, _: Path) -> int:
    vertices = len(re.findall(rb"^[ \t]*v[ \t]", content, re.MULTILINE))
    faces = re.findall(rb"^[ \t]*f[ \t]+(.*)$", content.replace(b"\\\n", b" "), re.MULTILINE)
    comments = b"\n".join(re.findall(rb"^[ \t]*#(.*)$", content, re.MULTILINE)).lower()
    for noun, found in (("vertices", vertices), ("faces", len(faces))):
        check_count(_count_in_comments(comments, noun), found, noun)
    for face in faces:
        corners = [corner.split(b"/")[0] for corner in face.split(b"#")[0].split()]
        if len(corners) < 3 or any(abs(int(corner)) > vertices or not int(corner) for corner in corners):
            text = face[:40].decode(errors="replace").strip()
            raise ValueError(f"it is truncated or damaged: the face {text!r} is not whole")
    return len(faces)


def _count_in_comments(comments: bytes, noun: str) -> int:
    """Return the number of `noun` that comments declare, as several writers do: "# Vertices: 8", "# 8 vertices"."""
    names = {"faces": rb"(?:faces|triangles)"}.get(noun, noun.encode())
    pattern = names + rb"[ \t]*:[ \t]*(\d+)[ \t\r]*$|^[ \t]*(\d+)[ \t]+" + names + rb"[ \t\r]*$"
    return sum(int(first or second) for first, second in re.findall(pattern, comments, re.MULTILINE))


def _check_ply(content: bytes, path: Path) -> int:
    header, counts = read_ply_header(path)
    if b"format ascii" in header:
        rows = content[len(header) :].split(b"\n")
        rows = [row.split() for row in rows if row.strip()]
        check_count(sum(counts.values()), len(rows), "elements")
        start = 0
        for name, count in counts.items():
            if name == b"face":
                whole = sum(len(row) > int(row[0]) for row in rows[start : start + count])
                check_count(count, whole, "faces")
            start += count
    else:
        check_count(sum(counts.values()), len(content) - len(header), "elements")
    return counts.get(b"face", 0)


_CHECKS = {".obj": _check_obj, ".stl": _check_stl, ".glb": _check_glb, ".off": _check_off, ".ply": _check_ply}
