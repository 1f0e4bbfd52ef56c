"""Feeds damaged and hostile datagrams and bundles to their parsers and checks the invariants that hold for any input.

python tests/planner/onboard/fuzz.py --seconds 600
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import math
import re
import resource
import socket
import struct
import sys
import tarfile
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from aero_planner.config import PlannerConfig
from aero_planner.deploy.bundle import open_bundle
from aero_planner.deploy.export import pack, write_manifest
from aero_planner.onboard.livox import LivoxPacket, LivoxSource, Reject, encode_packet, parse_packet
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.sweep_buffer import SweepBuffer
from aero_planner.onboard.thrust import ThrustModel

__all__ = ["TARGETS", "run"]

BATCH = 50
"""Number of datagrams between two polls, fewer than a socket's buffer holds."""
GROWTH = 64
"""Largest growth of this process's memory after the first batches [MB]."""

Random = np.random.Generator


def damaged(data: bytes, random: Random) -> bytes:
    """Return `data` with bytes changed, cut off, added, doubled or moved; sometimes unchanged."""
    result = bytearray(data)
    for _ in range(int(random.integers(0, 4))):
        at = int(random.integers(len(result) + 1))
        size = int(random.integers(1, 40))
        match int(random.integers(6)):
            case 0:
                result[at : at + 1] = random.bytes(1)
            case 1:
                del result[at:]
            case 2:
                result[at:at] = random.bytes(size)
            case 3:
                result[at : at + size] = bytes([int(random.choice([0, 1, 0x7F, 0x80, 0xFD, 0xFE, 0xFF]))] * size)
            case 4:
                result[at:at] = result[:at]
            case 5:
                del result[at : at + size]
    return bytes(result[:60_000])


class FuzzLivox:
    """Point packets, for the source and the sweep buffer."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.source = LivoxSource(0, host="127.0.0.1", clock=lambda: self.now)
        self.sweeps = SweepBuffer(capacity=20_000)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sequence = 0
        self.seen = 0

    def datagram(self, random: Random) -> bytes:
        if random.uniform() < 0.1:
            return random.bytes(int(random.integers(0, 2000)))
        count = int(random.integers(1, 100))
        points = random.normal(scale=10.0 ** random.uniform(-3, 8), size=(count, 3))
        points[random.uniform(size=count) < 0.1] = math.nan
        self.sequence += int(random.choice([1, 1, 1, 0, -1, 2, 70, 2000]))
        stamp = int((self.now + random.choice([0, 0, 0, 0, -2, 1e6]) * random.uniform()) * 1e9)
        data = bytearray(
            encode_packet(
                points,
                stamp_ns=int(random.choice([stamp, stamp, stamp, 0, 2**63 + 5])),
                interval=float(random.choice([475e-6, 0.0, 6.5e-3])),
                sequence=self.sequence,
                data_type=int(random.integers(1, 3)),
                tags=random.integers(0, 256, size=count),
            )
        )
        if random.uniform() < 0.3:  # invalid, but with a valid checksum
            at, size = [(0, 1), (1, 2), (3, 2), (5, 2), (10, 1), (11, 1), (28, 8)][random.integers(7)]
            data[at : at + size] = random.bytes(size)
            struct.pack_into("<I", data, 24, zlib.crc32(data[28:]))
        return damaged(bytes(data), random) if random.uniform() < 0.5 else bytes(data)

    def batch(self, random: Random) -> None:
        for _ in range(BATCH):
            data = self.datagram(random)
            packet = parse_packet(data)
            assert isinstance(packet, LivoxPacket | Reject)
            assert not isinstance(packet, LivoxPacket) or len(packet.payload) + 36 == len(data)
            self.socket.sendto(data, ("127.0.0.1", self.source.port))
        self.now += random.exponential(0.02)
        self.sweeps.add_pose(self.now - 0.001, random.normal(size=3), (1.0, 0.0, 0.0, 0.0))
        for packet in self.source.poll():
            assert packet.points.shape == (len(packet.times), 3)
            assert np.isfinite(packet.points).all()
            assert np.isfinite(packet.times).all()
            assert (packet.times <= self.now + 1e-6).all()
            self.sweeps.add_points(packet.points, packet.times)
        cloud = self.sweeps.cloud(self.now)[0].points
        assert len(cloud) <= 20_000
        assert np.isfinite(cloud).all()
        self.seen = self.source.counters.packets

    def close(self) -> None:
        self.source.close()
        self.socket.close()


class FuzzMavlink:
    """Messages of all kinds, from the autopilot and from other senders."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.dialect = load_dialect()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        senders = [(1, None), (200, None), (200, "127.0.0.1")]
        self.link = MavlinkLink(
            f"udpin:127.0.0.1:{self.port}", ThrustModel(), goal_senders=senders, clock=lambda: self.now
        )
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sequence, self.wild = 0, False
        self.kinds = list(self.dialect.mavlink_map.values())
        names = ("ODOMETRY", "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION", "HEARTBEAT", "SET_POSITION_TARGET_LOCAL_NED")
        self.used = [kind for kind in self.kinds if kind.msgname in names]
        self.seen = 0

    def message(self, random: Random) -> bytes:
        if random.uniform() < 0.1:
            return random.bytes(int(random.integers(0, 2000)))
        known = self.used if random.uniform() < 0.8 else self.kinds
        data = self.frame(known[random.integers(len(known))], random)
        return damaged(data, random) if random.uniform() < 0.4 else data

    def frame(self, kind, random: Random) -> bytes:
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

    def batch(self, random: Random) -> None:
        for _ in range(BATCH):
            data = b"".join(self.message(random) for _ in range(int(random.integers(1, 4))))
            self.socket.sendto(data[:60_000], ("127.0.0.1", self.port))
        self.now += random.exponential(0.02)
        self.link.poll()
        self.link.send(random.normal(scale=100.0, size=4))
        sample = self.link.state
        if sample is not None:
            self.seen += 1
            state = sample.state
            for part in (state.position, state.velocity, state.quaternion):
                assert np.isfinite(part).all()
            assert abs(np.linalg.norm(np.asarray(state.quaternion)) - 1.0) < 1e-6
            assert sample.time <= self.now + 1e-6
        assert self.link.goal is None or np.isfinite(self.link.goal).all()
        assert len(self.link.received) <= len(self.kinds) + 1
        assert self.link.parser.buffered == 0

    def close(self) -> None:
        self.link.close()
        self.socket.close()


class FuzzBundle:
    """Bundles as tar files, which are opened and checked against a configuration."""

    def __init__(self) -> None:
        self.seen = 0
        # In memory if possible, because a disk would take most of the time.
        self.temporary = tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None)
        self.root = Path(self.temporary.name)
        # Deep enough that files which escape through a few ".." still land in this folder.
        self.copies = self.root / "1/2/3/4"
        self.copies.mkdir(parents=True)
        folder = self.root / "bundle"
        (folder / "kernels/a").mkdir(parents=True)
        for name in ("a.sm87.cubin", "a.o", "a.meta"):
            (folder / "kernels/a" / name).write_bytes(name.encode() * 100)
        (folder / "config.yaml").write_text("costs:\n  q_track: 7.5\n")
        self.manifest = write_manifest(folder, [87], True)
        pack(folder, self.root / "whole.tar", self.manifest)
        self.whole = (self.root / "whole.tar").read_bytes().rstrip(b"\0") + bytes(1024)
        self.file = self.root / "bundle.tar"
        self.file.touch()
        self.before = self.listing()
        self.directory, tempfile.tempdir = tempfile.tempdir, str(self.copies)

    def listing(self) -> list[tuple[str, int]]:
        return sorted((str(path), path.lstat().st_mode) for path in self.root.rglob("*"))

    def content(self, random: Random) -> bytes:
        kind = random.uniform()
        if kind < 0.1:
            return random.bytes(int(random.integers(0, 3000)))
        if kind < 0.4:
            return damaged(self.whole, random)
        if kind < 0.7:
            return self.entry(random) + self.whole
        manifest = self.altered(json.loads(json.dumps(self.manifest)), random)
        text = json.dumps(manifest).encode()
        if random.uniform() < 0.2:
            text = damaged(text, random)
        output = io.BytesIO()
        with tarfile.open(fileobj=output, mode="w", format=tarfile.USTAR_FORMAT) as archive:
            for member in (whole := tarfile.open(fileobj=io.BytesIO(self.whole))):  # noqa: SIM115
                content = text if member.name == "manifest.json" else (whole.extractfile(member) or io.BytesIO()).read()
                member.size = len(content)
                archive.addfile(member, io.BytesIO(content))
        return output.getvalue()

    def entry(self, random: Random) -> bytes:
        """Return a hostile entry with a valid checksum."""
        names = [
            "../x",
            "/tmp/x",
            "a/../../x",
            "kernels",
            "kernels/a/a.o",
            "b/c/d",
            "",
            ".",
            "x\n",
            "\x7f",
            "config.yaml",
        ]
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

    def altered(self, manifest: dict, random: Random) -> dict:
        """Return a manifest with a wrong value in a random place."""
        wrong = [None, -1, 0, 1, 2**70, 1.5, math.nan, "", "x" * 1000, "../x", [], {}, [[]], True, ["a"], {"a": 1}]
        place = manifest
        while random.uniform() < 0.5 and (inner := [key for key in place if isinstance(place[key], dict)]):
            place = place[inner[random.integers(len(inner))]]
        key = str(random.choice([*place, "../x", "kernels/../../x", "kernels/a"]))
        place[key] = wrong[random.integers(len(wrong))]
        return manifest

    def batch(self, random: Random) -> None:
        for _ in range(BATCH):
            self.file.write_bytes(self.content(random))
            try:
                bundle = open_bundle(self.file)
            except ValueError as error:
                assert str(error).endswith(".") and "\n" not in str(error), str(error)
            else:
                with bundle:
                    self.seen += 1
                    self.look(bundle.folder)
                    try:
                        bundle.fit(PlannerConfig(), "cpu")
                    except ValueError as error:
                        assert "export it again" in str(error)
            assert self.listing() == self.before

    def look(self, folder: Path) -> None:
        """Check that the copied files have the names and contents of exported ones."""
        for path in folder.rglob("*"):
            if path.is_file() and not path.is_symlink():
                said = self.manifest["files"][path.relative_to(folder).as_posix()]
                assert hashlib.sha256(path.read_bytes()).hexdigest() == said["sha256"]
            else:
                assert path.is_dir()

    def close(self) -> None:
        tempfile.tempdir = self.directory
        self.temporary.cleanup()


Target = FuzzLivox | FuzzMavlink | FuzzBundle
TARGETS: dict[str, Callable[[], Target]] = {"livox": FuzzLivox, "mavlink": FuzzMavlink, "bundle": FuzzBundle}


def memory() -> float:
    """Return the peak memory of this process [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def run(name: str, *, seed: int = 0, batches: int | None = None, seconds: float | None = None) -> tuple[int, float]:
    """Fuzz one target for a number of batches or a time; return the number of inputs and the growth of memory [MB].

    Raises:
        AssertionError: An invariant was violated.
    """
    target = TARGETS[name]()
    random = np.random.default_rng(seed)
    warm_up = 40
    began, start, done = time.monotonic(), math.nan, 0
    try:
        while done < batches if batches is not None else time.monotonic() - began < (seconds or 0.0):
            target.batch(random)
            done += 1
            if done == warm_up:
                start = memory()
        assert target.seen > 0, "no input was accepted: the fuzzer produces only inputs that are refused at once"
    finally:
        target.close()
    growth = memory() - start
    assert not growth > GROWTH, f"memory grew by {growth:.0f} MB"
    return done * BATCH, growth


def main() -> int:
    """Run every target in turn, each for an equal share of the time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="total time of all targets [s]")
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    for name in TARGETS:
        count, growth = run(name, seed=options.seed, seconds=options.seconds / len(TARGETS))
        print(f"{name}: {count} inputs, seed {options.seed}, memory +{growth:.1f} MB", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
