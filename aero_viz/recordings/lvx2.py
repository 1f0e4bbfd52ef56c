"""Livox's .lvx2: the packets of one or more sensors, after the "LVX2 Specifications" of Livox Viewer 2."""

from __future__ import annotations

import contextlib
import socket
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from aero_planner.onboard.livox import LivoxPacket
from aero_planner.quaternions import quaternion_from_angles
from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.recordings.bag_file import Mounting
from aero_viz.recordings.sensors import choose_sensor

LVX_MAGIC = b"livox_tech"
_HEADER, _FRAME = 24 + 5, 24
_DEVICE = struct.Struct("<16s16sIBBB6f")
"""Serial numbers, number of the sensor, its kind, whether its pose counts, roll, pitch, yaw [deg], x, y, z [m]."""
_PACKAGE = struct.Struct("<BIBBQHBIB4x")
_POINT_SIZES = {1: 14, 2: 8}
_POINT_INTERVAL = 1e9 / 200_000  # of a Mid-360 [ns]; .lvx2 does not say
_PACKAGE_MAX = 1 << 20
_FARTHEST = 100.0
"""A sensor is mounted nearer to the origin of the body [m]."""


class Lvx2Sensor(NamedTuple):
    """The sensor of a file that is played."""

    number: int
    mounting: Mounting | None
    notice: str
    """Sentence on the sensors that are left out; empty if there are none."""


def find_sensor(path: Path, wanted: str | None) -> Lvx2Sensor:
    """Return the sensor to play, see `choose_sensor`.

    Raises:
        UserError: it is a file of Livox's older format, or no sensor has the wanted name.
    """
    names, mountings = {}, {}
    with open_user_file(path) as file:
        for serial, _, number, _, _, is_mounted, *pose in _devices(path, file):
            names[number] = serial.rstrip(b"\0").decode("ascii", errors="replace").strip("\0 ") or _address(number)
            if is_mounted and np.isfinite(pose).all() and np.abs(pose[3:]).max() < _FARTHEST:
                mountings[number] = _mounting(pose, names[number])
    counts: Counter[int] = Counter()
    with contextlib.suppress(EOFError, ValueError):
        for number, packet in _packages(path):
            counts[number] += packet.count
    by_name = {_printable(names.get(number, _address(number))): number for number in sorted(counts)} or {"": 0}
    chosen, notice = choose_sensor({name: counts[number] for name, number in by_name.items()}, wanted, path)
    return Lvx2Sensor(by_name[chosen], mountings.get(by_name[chosen]), notice)


def lvx2_packets(path: Path, sensor: Lvx2Sensor) -> Iterator[LivoxPacket]:
    """Yield the point packets of a sensor.

    Raises:
        UserError: it is a file of Livox's older format.
        EOFError: it is truncated.
        ValueError: it is damaged.
    """
    return (packet for number, packet in _packages(path) if number == sensor.number)


def _devices(path: Path, file: BinaryIO) -> list[tuple[bytes, bytes, int, int, int, int, float, float]]:
    """Return the descriptions of the sensors, behind which the file is left."""
    head = file.read(_HEADER)
    if len(head) < _HEADER or head[16] != 2:
        raise UserError(f"{path} is not an .lvx2 file (version 2); export it again with Livox Viewer 2.")
    content = file.read(_DEVICE.size * head[28])
    return list(_DEVICE.iter_unpack(content[: len(content) // _DEVICE.size * _DEVICE.size]))


def _mounting(pose: list[float], name: str) -> Mounting:
    roll, pitch, yaw, *place = pose
    words = " ".join(f"{value:g}" for value in (*place, roll, pitch, yaw))
    notice = (
        f"the file mounts the sensor {_printable(name)} at x y z {' '.join(f'{value:g}' for value in place)} m, roll "
        f"pitch yaw {roll:g} {pitch:g} {yaw:g} deg; --extrinsic replaces this ({words})"
    )
    return Mounting(np.array(place), quaternion_from_angles(roll, pitch, yaw), notice)


def _address(number: int) -> str:
    """Return the address of a sensor, which is its number."""
    return socket.inet_ntoa(struct.pack("<I", number)) if number > 1 << 24 else str(number)


def _printable(name: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in name)


def _packages(path: Path) -> Iterator[tuple[int, LivoxPacket]]:
    with open_user_file(path) as file:
        _devices(path, file)
        while frame := file.read(_FRAME):
            if len(frame) < _FRAME:
                raise EOFError
            here, after, _ = struct.unpack("<3Q", frame)
            end = file.tell() - _FRAME + (after - here)
            while file.tell() < end:
                yield _package(file)


def _package(file: BinaryIO) -> tuple[int, LivoxPacket]:
    header = file.read(_PACKAGE.size)
    if len(header) < _PACKAGE.size:
        raise EOFError
    _, number, _, time_type, stamp, sequence, kind, length, _ = _PACKAGE.unpack(header)
    size = _POINT_SIZES.get(kind)
    if length > _PACKAGE_MAX or size is None or length % size:
        raise ValueError(
            f"damaged, a package claims {length} bytes of points of type {kind}: only the data before it is used"
        )
    payload = file.read(length)
    if len(payload) < length:
        raise EOFError
    count = length // size
    interval = 1e-9 * _POINT_INTERVAL * max(count - 1, 0)
    return number, LivoxPacket(stamp, interval, count, sequence, kind, time_type, payload)
