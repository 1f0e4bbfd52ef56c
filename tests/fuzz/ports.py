"""Hostile input for the ports of the onboard node, and for bundles: what is sent, and what must hold whatever is sent.

Nothing here needs more than the planner's package, so that its lowest versions are fuzzed as well.
"""

import hashlib
import io
import json
import math
import os
import re
import socket
import struct
import tarfile
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.mutation import mutate, pack, unpack

from aero_planner.config import PlannerConfig
from aero_planner.deploy.bundle import open_bundle
from aero_planner.deploy.export import pack as pack_bundle
from aero_planner.deploy.export import write_manifest
from aero_planner.onboard.livox import LivoxPacket, LivoxSource, Reject, encode_packet, parse_packet
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.sweep_buffer import SweepBuffer
from aero_planner.onboard.thrust import ThrustModel

Random = np.random.Generator

POLLS, BATCH = 6, 50
"""Polls of a case, and datagrams between two of them, fewer than a socket's buffer holds."""
PERIOD = 0.02
START = 1000.0
"""Host time of the first poll [s]."""


@dataclass(frozen=True)
class Port:
    """One kind of input."""

    generate: Callable[[Random], bytes]
    """Returns the content of a case."""
    feed: Callable[[Path], int]
    """Feeds a case to its parser and returns how many of its inputs were accepted.

    Raises AssertionError if an invariant is violated, and ValueError with one sentence where an input is refused.
    """
    inputs: int
    """Number of inputs in a case."""


def _livox_datagram(random: Random, now: float, sequence: int) -> bytes:
    if random.uniform() < 0.1:
        return random.bytes(int(random.integers(0, 2000)))
    count = int(random.integers(1, 100))
    points = random.normal(scale=10.0 ** random.uniform(-3, 8), size=(count, 3))
    points[random.uniform(size=count) < 0.1] = math.nan
    stamp = int((now + random.choice([0, 0, 0, 0, -2, 1e6]) * random.uniform()) * 1e9)
    data = bytearray(
        encode_packet(
            points,
            stamp_ns=int(random.choice([stamp, stamp, stamp, 0, 2**63 + 5])),
            interval=float(random.choice([475e-6, 0.0, 6.5e-3])),
            sequence=sequence,
            data_type=int(random.integers(1, 3)),
            tags=random.integers(0, 256, size=count),
        )
    )
    if random.uniform() < 0.3:  # invalid, but with a valid checksum
        at, size = [(0, 1), (1, 2), (3, 2), (5, 2), (10, 1), (11, 1), (28, 8)][random.integers(7)]
        data[at : at + size] = random.bytes(size)
        struct.pack_into("<I", data, 24, zlib.crc32(data[28:]))
    return mutate(bytes(data), random) if random.uniform() < 0.5 else bytes(data)


def _livox_case(random: Random) -> bytes:
    """Return packets of points, whole and damaged."""
    sequence, datagrams = 0, []
    for k in range(POLLS * BATCH):
        sequence += int(random.choice([1, 1, 1, 0, -1, 2, 70, 2000]))
        datagrams.append(_livox_datagram(random, START + PERIOD * (k // BATCH), sequence))
    return pack(datagrams)


def _feed_livox(path: Path) -> int:
    """Send packets to a source of points, and check what reaches the cloud."""
    datagrams, now = unpack(path), START
    source, sweeps = LivoxSource(0, host="127.0.0.1", clock=lambda: now), SweepBuffer(capacity=20_000)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for first in range(0, len(datagrams), BATCH):
            for data in datagrams[first : first + BATCH]:
                packet = parse_packet(data)
                assert isinstance(packet, LivoxPacket | Reject)
                assert not isinstance(packet, LivoxPacket) or len(packet.payload) + 36 == len(data)
                sender.sendto(data, ("127.0.0.1", source.port))
            now += PERIOD
            sweeps.add_pose(now - 0.001, (0.1 * first, 0.0, 2.0), (1.0, 0.0, 0.0, 0.0))
            for packet in source.poll():
                assert packet.points.shape == (len(packet.times), 3)
                assert np.isfinite(packet.points).all()
                assert np.isfinite(packet.times).all()
                assert (packet.times <= now + 1e-6).all()
                sweeps.add_points(packet.points, packet.times)
            cloud = sweeps.cloud(now)[0].points
            assert len(cloud) <= 20_000
            assert np.isfinite(cloud).all()
    source.close()
    return source.counters.packets


class _Messages:
    """Messages of all kinds, from the autopilot and from other senders, with valid checksums or damage."""

    def __init__(self) -> None:
        self.dialect = load_dialect()
        self.kinds = list(self.dialect.mavlink_map.values())
        names = (
            "ODOMETRY", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "HEARTBEAT", "SET_POSITION_TARGET_LOCAL_NED",
            "EXTENDED_SYS_STATE", "DISTANCE_SENSOR", "PARAM_VALUE",
        )  # fmt: skip
        self.used = [kind for kind in self.kinds if kind.msgname in names]
        self.sequence, self.wild, self.now = 0, False, START

    def message(self, random: Random) -> bytes:
        if random.uniform() < 0.1:
            return random.bytes(int(random.integers(0, 2000)))
        known = self.used if random.uniform() < 0.8 else self.kinds
        data = self.frame(known[random.integers(len(known))], random)
        return mutate(data, random) if random.uniform() < 0.4 else data

    def frame(self, kind: Any, random: Random) -> bytes:
        """Return a message with arbitrary values and a valid checksum, sometimes truncated as trailing zeros may be."""
        names = [n for n, count in zip(kind.ordered_fieldnames, kind.lengths, strict=True) for _ in range(count)]
        groups = re.findall(r"([0-9]*)([a-zA-Z])", kind.unpacker.format)
        forms = [form for count, form in groups for _ in range(int(count or 1))]
        if "s" in forms or "c" in forms:
            payload = random.bytes(kind.unpacker.size)
        else:
            self.wild = bool(random.uniform() < 0.5)
            values = [self.value(name, form, random) for name, form in zip(names, forms, strict=True)]
            payload = struct.pack("<" + "".join(forms), *values)
        if random.uniform() < 0.1:
            payload = payload[: int(random.integers(1, len(payload) + 1))]
        sender = bytes((1, 1) if random.uniform() < 0.9 else (200, 7))
        self.sequence = (self.sequence + 1) % 256
        if kind.id < 256 and random.uniform() < 0.1:
            head = bytes([0xFE, len(payload), self.sequence]) + sender + bytes([kind.id])
        else:
            head = bytes([0xFD, len(payload), 0, 0, self.sequence]) + sender + kind.id.to_bytes(3, "little")
        checksum = self.dialect.x25crc(head[1:] + payload + bytes([kind.crc_extra])).crc
        return head + payload + struct.pack("<H", checksum)

    def value(self, name: str, form: str, random: Random) -> float | int:
        if name in ("q", "q1", "q2", "q3", "q4") and random.uniform() < 0.95:
            return 0.5  # four of them form a unit quaternion
        if name in ("frame_id", "child_frame_id", "coordinate_frame") and random.uniform() < 0.8:
            return int(random.choice([1, 8, 12, 20]))
        if name in ("target_system", "target_component") and random.uniform() < 0.8:
            return 0
        if form in "fd" and not self.wild:
            return float(random.normal(scale=10.0))
        if form in "fd":
            sane = random.normal(scale=10.0 ** random.uniform(-3, 8))
            return float(random.choice([sane, sane, sane, sane, 0.5, math.nan, math.inf, -math.inf, 3e38, 0.0]))
        bits = 8 * struct.calcsize("<" + form)
        low = -(2 ** (bits - 1)) if form.islower() else 0
        high = low + 2**bits - 1
        if name in ("time_usec", "time_boot_ms") and random.uniform() < 0.9:
            return int(self.now * (1e6 if name == "time_usec" else 1e3)) & high
        if random.uniform() < 0.8:
            return int(random.integers(0, 20))
        return (low, high)[random.integers(2)] if bits == 64 else int(random.integers(low, high + 1))


def _mavlink_case(random: Random) -> bytes:
    """Return datagrams of one to three messages."""
    messages = _Messages()
    datagrams = []
    for k in range(POLLS * BATCH):
        messages.now = START + PERIOD * (k // BATCH)
        datagrams.append(b"".join(messages.message(random) for _ in range(int(random.integers(1, 4)))))
    return pack(datagrams)


def _feed_mavlink(path: Path) -> int:
    """Send datagrams to a link over UDP."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        address = probe.getsockname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        return _feed_link(
            f"udpin:127.0.0.1:{address[1]}", lambda data: sender.sendto(data[:60_000], address), unpack(path)
        )


def _feed_serial(path: Path) -> int:
    """Send the same as a stream of bytes to a link on a serial device."""
    there, device = os.openpty()
    os.set_blocking(there, False)
    try:
        return _feed_link(os.ttyname(device), lambda data: _write(there, data), unpack(path))
    finally:
        os.close(there)
        os.close(device)


def _write(file: int, data: bytes) -> None:
    with open(os.dup(file), "wb", buffering=0) as stream:
        stream.write(data[:300])  # a terminal's buffer has 4 kB, and the link reads what it holds at every poll


def _feed_link(url: str, send: Callable[[bytes], object], datagrams: list[bytes]) -> int:
    now = START
    senders = [(1, None), (200, None), (200, "127.0.0.1")]
    link = MavlinkLink(url, ThrustModel(), goal_senders=senders, clock=lambda: now)
    secured = MavlinkLink("udpin:127.0.0.1:0", ThrustModel(), key=bytes(32), clock=lambda: now)
    is_serial = url.startswith("/")
    batch, states = 8 if is_serial else BATCH, 0
    try:
        for first in range(0, len(datagrams), batch):
            for data in datagrams[first : first + batch]:
                send(data)
                assert not secured.parser.parse(data), "an unsigned message was accepted"
            now += PERIOD * batch / BATCH
            link.poll()
            link.send((40.0, -30.0, 1e3, -1e3))
            sample = link.state
            if sample is not None:
                states += 1
                state = sample.state
                for part in (state.position, state.velocity, state.quaternion):
                    assert np.isfinite(part).all()
                assert abs(np.linalg.norm(np.asarray(state.quaternion)) - 1.0) < 1e-6
                assert sample.time <= now + 1e-6
            assert link.goal is None or np.isfinite(link.goal).all()
            assert len(link.received) <= len(load_dialect().mavlink_map) + 1
            assert link.parser.buffered <= (300 if is_serial else 0)
    finally:
        link.close()
        secured.close()
    return states


@cache
def _whole_bundle() -> tuple[bytes, dict[str, Any]]:
    """Return a small bundle as a tar file, and its manifest."""
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root) / "bundle"
        (folder / "kernels/a").mkdir(parents=True)
        for name in ("a.sm87.cubin", "a.o", "a.meta"):
            (folder / "kernels/a" / name).write_bytes(name.encode() * 100)
        (folder / "config.yaml").write_text("costs:\n  q_track: 7.5\n")
        manifest = write_manifest(folder, [87], True)
        pack_bundle(folder, Path(root) / "whole.tar", manifest)
        return (Path(root) / "whole.tar").read_bytes().rstrip(b"\0") + bytes(1024), manifest


def _bundle_case(random: Random) -> bytes:
    """Return a bundle that is damaged, has a hostile entry, or another manifest."""
    whole, manifest = _whole_bundle()
    kind = random.uniform()
    if kind < 0.1:
        return random.bytes(int(random.integers(0, 3000)))
    if kind < 0.4:
        return mutate(whole, random)
    if kind < 0.7:
        return _hostile_entry(random) + whole
    text = json.dumps(_altered(json.loads(json.dumps(manifest)), random)).encode()
    if random.uniform() < 0.2:
        text = mutate(text, random)
    output = io.BytesIO()
    with tarfile.open(fileobj=output, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for member in (source := tarfile.open(fileobj=io.BytesIO(whole))):  # noqa: SIM115
            content = text if member.name == "manifest.json" else (source.extractfile(member) or io.BytesIO()).read()
            member.size = len(content)
            archive.addfile(member, io.BytesIO(content))
    return output.getvalue()


def _hostile_entry(random: Random) -> bytes:
    """Return an entry of a tar file with a valid checksum."""
    names = ["../x", "/tmp/x", "a/../../x", "kernels", "kernels/a/a.o", "b/c/d", "", ".", "x\n", "\x7f", "config.yaml"]
    header = tarfile.TarInfo(str(random.choice(names)))
    header.type = bytes(random.choice(np.frombuffer(b"01234567xgLKSV\0", dtype="S1")))[:1] or b"\0"
    header.linkname = str(random.choice(["", "../x", "/etc/passwd", "kernels"]))
    header.size = int(random.choice([0, 0, 0, 7, 512, 2**20, 2**33 - 1]))
    buffer = bytearray(header.tobuf(tarfile.USTAR_FORMAT))
    if random.uniform() < 0.3:  # sizes in base 256, including negative ones
        buffer[124:136] = bytes([int(random.choice([0x80, 0xFF]))]) + random.bytes(11)
    at = int(random.integers(0, 500))
    if random.uniform() < 0.3:
        buffer[at : at + 4] = random.bytes(4)
    buffer[148:156] = b"        "
    buffer[148:156] = b"%06o\0 " % sum(buffer)
    return bytes(buffer)


def _altered(manifest: dict[str, Any], random: Random) -> dict[str, Any]:
    """Return a manifest with a wrong value in a random place."""
    wrong = [None, -1, 0, 1, 2**70, 1.5, math.nan, "", "x" * 1000, "../x", [], {}, [[]], True, ["a"], {"a": 1}]
    place = manifest
    while random.uniform() < 0.5 and (inner := [key for key in place if isinstance(place[key], dict)]):
        place = place[inner[random.integers(len(inner))]]
    key = str(random.choice([*place, "../x", "kernels/../../x", "kernels/a"]))
    place[key] = wrong[random.integers(len(wrong))]
    return manifest


def _feed_bundle(path: Path) -> int:
    """Open a bundle in a folder of its own; nothing may appear outside of it."""
    directory = tempfile.tempdir
    # In memory if possible, because a disk would take most of the time. Deep enough that files which escape through a
    # few ".." still land in this folder.
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as root:
        copies = Path(root, "1/2/3/4")
        copies.mkdir(parents=True)
        tempfile.tempdir, before = str(copies), _listing(Path(root))
        try:
            with open_bundle(path) as bundle:
                for file in bundle.folder.rglob("*"):
                    if file.is_file() and not file.is_symlink():
                        entry = _whole_bundle()[1]["files"][file.relative_to(bundle.folder).as_posix()]
                        assert hashlib.sha256(file.read_bytes()).hexdigest() == entry["sha256"]
                    else:
                        assert file.is_dir()
                try:
                    bundle.activate(PlannerConfig(), "cpu")
                except ValueError as error:
                    assert "export it again" in str(error)
            return 1
        finally:
            tempfile.tempdir = directory
            assert _listing(Path(root)) == before


def _listing(root: Path) -> list[tuple[str, int]]:
    return sorted((str(path), path.lstat().st_mode) for path in root.rglob("*"))


PORTS: dict[str, Port] = {
    "lidar.datagrams": Port(_livox_case, _feed_livox, POLLS * BATCH),
    "mavlink.datagrams": Port(_mavlink_case, _feed_mavlink, POLLS * BATCH),
    "mavlink.serial": Port(_mavlink_case, _feed_serial, POLLS * BATCH),
    "a.bundle": Port(_bundle_case, _feed_bundle, 1),
}
"""By name of the case's file."""
