"""Points of E57 files, which pye57 writes here."""

import os
import re
import struct
from collections.abc import Callable
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
            fields = {
                f"cartesian{axis}": column for axis, column in zip("XYZ", np.ascontiguousarray(scan.T), strict=True)
            }
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


def checksum(page: bytes) -> int:
    """Return CRC-32C."""
    value = 0xFFFFFFFF
    for byte in page:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
    return value ^ 0xFFFFFFFF


def edit_xml(path: Path, edit: Callable[[bytes], bytes]) -> None:
    """Replace the XML part at the end of a file, which has pages of 1024 bytes that end in a checksum."""
    content = path.read_bytes()
    data = b"".join(content[i : i + 1020] for i in range(0, len(content), 1024))
    begin, length = struct.unpack_from("<QQ", data, 24)
    begin -= begin // 1024 * 4
    xml = edit(data[begin : begin + length])
    whole = bytearray(data[:begin] + xml)
    whole += bytes(-len(whole) % 1020)
    struct.pack_into("<Q", whole, 16, len(whole) // 1020 * 1024)
    struct.pack_into("<Q", whole, 32, len(xml))
    pages = (bytes(whole[i : i + 1020]) for i in range(0, len(whole), 1020))
    path.write_bytes(b"".join(page + struct.pack(">I", checksum(page)) for page in pages))


DEFINITIONS = {
    "document type": '<!DOCTYPE e57Root SYSTEM "{pipe}">',
    "server": '<!DOCTYPE e57Root SYSTEM "http://127.0.0.1:9/a.dtd">',
    "file": '<!DOCTYPE e57Root [<!ENTITY a SYSTEM "{pipe}"> %s]>',
    "bomb": '<!DOCTYPE e57Root [<!ENTITY b "{long}"><!ENTITY c "{b}"><!ENTITY d "{c}"><!ENTITY a "{d}"> %s]>',
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("name", DEFINITIONS)
def test_the_xml_part_opens_no_other_file_and_does_not_expand(tmp_path: Path, name: str, encoding: str):
    os.mkfifo(tmp_path / "pipe")
    write(tmp_path / "a.e57", POINTS)
    words = {"pipe": str(tmp_path / "pipe"), "long": "x" * 1000} | {b: f"&{b};" * 300 for b in "bcd"}

    def define(xml: bytes) -> bytes:
        names = sorted({*re.findall(r"<(\w+)", text := xml.decode())} - {"xml"})
        known = "".join(f"<!ELEMENT {name} ANY>" for name in names)
        attributes = ("type", "xmlns", "fileOffset", "recordCount", "precision", "minimum", "maximum")
        attributes += ("allowHeterogeneousChildren",)
        known += "".join(f"<!ATTLIST {name} {' '.join(f'{a} CDATA #IMPLIED' for a in attributes)}>" for name in names)
        definition = DEFINITIONS[name].format(**words).replace("%s", known)
        text = text.replace("<e57Root", f"{definition}<e57Root", 1).replace("</guid>", "&a;</guid>", 1)
        return text.replace("UTF-8", encoding.upper(), 1).encode(encoding)

    edit_xml(tmp_path / "a.e57", define)
    with pytest.raises(UserError, match="a document type or defines entities"):
        load_map(tmp_path / "a.e57")


def test_a_scan_with_fewer_points_than_its_header_declares_is_truncated(tmp_path: Path):
    write(tmp_path / "a.e57", POINTS)
    edit_xml(tmp_path / "a.e57", lambda xml: xml.replace(b'recordCount="500"', b'recordCount="900"'))
    with pytest.raises(UserError, match="declares 900 points, and it holds 500"):
        load_map(tmp_path / "a.e57")


def test_the_parts_of_a_rotation_are_found_by_their_names(tmp_path: Path):
    half = np.sqrt(0.5)
    write(tmp_path / "a.e57", POINTS, rotation=np.array([half, 0.0, 0.0, half]))
    first = re.compile(rb"(?s)(<rotation[^>]*>\s*)(<w.*?</w>)(.*?)(</rotation>)")
    edit_xml(tmp_path / "a.e57", lambda xml: first.sub(rb"\1\3\2\4", xml))
    turned = np.column_stack([-POINTS[:, 1], POINTS[:, 0], POINTS[:, 2]])
    np.testing.assert_allclose(read(tmp_path / "a.e57"), turned, atol=1e-3)
    edit_xml(tmp_path / "a.e57", lambda xml: re.sub(rb"<([wz]) type=.Float.>[^<]*", rb'<\1 type="Float">0', xml))
    with pytest.raises(UserError, match="a quaternion of the length 0"):
        load_map(tmp_path / "a.e57")


def test_ranges_and_angles_become_points(tmp_path: Path):
    distance = np.linalg.norm(POINTS, axis=1)
    azimuth, elevation = np.arctan2(POINTS[:, 1], POINTS[:, 0]), np.arcsin(POINTS[:, 2] / distance)
    invalid = (np.arange(500) % 5 == 0).astype(np.int8)
    write(tmp_path / "a.e57", np.column_stack([distance, azimuth, elevation]), states=invalid)
    names = dict(zip("XYZI", ("Range", "Azimuth", "Elevation", "I"), strict=True))
    edit_xml(
        tmp_path / "a.e57",
        lambda xml: re.sub(r"cartesian([XYZI])", lambda found: f"spherical{names[found[1]]}", xml.decode()).encode(),
    )
    np.testing.assert_allclose(read(tmp_path / "a.e57"), POINTS[invalid == 0], atol=1e-3)
