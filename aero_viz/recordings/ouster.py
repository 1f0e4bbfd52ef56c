"""Captures of Ouster's sensors: .pcap with the metadata of the sensor (JSON), and OSF.

ouster-sdk decodes them in a separate process, because it changes modules that the session uses and may crash.
"""

from __future__ import annotations

import importlib
import importlib.util
import shutil
import struct
import tempfile
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import expansion_limit
from aero_viz.reader_process import Limits, ReaderProcess
from aero_viz.recordings.bag_file import one_line
from aero_viz.recordings.cloud_files import StampedCloud
from aero_viz.recordings.imu_messages import ImuRows
from aero_viz.recordings.pcap import udp_payloads

INSTALL = "pip install --no-deps ouster-sdk"
"""Its requirements exclude the versions of rosbags and psutil that AERO-Viz needs; decoding needs neither."""

_HEADER = struct.Struct("<qI")
_KEY = b"beam_altitude_angles"
_METADATA_MAX = 1 << 20


class _Decoded(NamedTuple):
    """Metadata of a capture."""

    imu: NDArray[np.float64]
    """Angular velocity [rad/s] and specific force [m/s^2] [n, 6]."""
    imu_stamps: NDArray[np.int64]
    """[n] [ns]."""
    problem: str
    """Reason why the rest cannot be decoded; empty if there is none."""


def find_metadata(path: Path) -> Path | None:
    """Return the file next to a capture that holds the metadata of its sensor; None if there is none.

    Of several, it is the one whose name shares the longest prefix with that of the capture. JSON files that share no
    prefix, or are not metadata of an Ouster, are skipped.
    """
    files = [file for file in path.parent.glob("*.json") if file.is_file()]
    common = {
        file: sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(file.name, path.name, strict=False)))
        for file in files
    }
    for file in sorted(files, key=lambda file: (-common[file], file.name)):
        with open_user_file(file) as content:
            if common[file] and _KEY in content.read(_METADATA_MAX):
                return file
    return None


def ouster_sweeps(path: Path, imu: ImuRows, *, is_osf: bool) -> Iterator[StampedCloud]:
    """Yield the sweeps of a capture, and add the samples of the IMU to `imu` before the first of them.

    The first returns of the first sensor are used.

    Raises:
        UserError: ouster-sdk is not installed, the metadata of the sensor are missing, or there is no sweep.
        EOFError: the file is truncated.
        ValueError: it is damaged.
    """
    if importlib.util.find_spec("ouster") is None:
        raise UserError(f"{path} holds data of an Ouster, which ouster-sdk decodes: {INSTALL}")
    metadata = None if is_osf else find_metadata(path)
    if not is_osf and metadata is None:
        raise UserError(
            f"{path} needs the metadata of the sensor: put the JSON file that was recorded with it into its folder, "
            f"as {path.stem}.json."
        )
    with tempfile.TemporaryDirectory(prefix="aero-viz-") as folder:
        spool, problem = Path(folder) / "sweeps", ""
        spool.touch()
        try:
            size = path.stat().st_size
            limit = min(expansion_limit(size), shutil.disk_usage(folder).free // 2)
            process = ReaderProcess(Limits.for_file(size))
            decoded = process(_decode, str(path), str(metadata), str(spool), limit, is_osf=is_osf)
            problem = decoded.problem
            for stamp, row in zip(decoded.imu_stamps, decoded.imu, strict=True):
                imu.add(int(stamp), row[:3], row[3:])
        except UserError as error:
            problem = str(error).rstrip(".")
        with spool.open("rb") as file:
            count = 0
            for sweep in _spooled(file):
                yield sweep
                count += 1
    if not count:
        raise UserError(
            f"{path} holds no sweep that can be decoded ({problem or 'nothing is complete'}): copy it again."
        )
    if not is_osf:
        for _ in udp_payloads(path):  # ouster-sdk does not say that a capture is truncated
            pass
    if problem:
        raise ValueError(f"damaged ({problem}): only the data before the damage is used")


def _spooled(file: BinaryIO) -> Iterator[StampedCloud]:
    """Yield the sweeps in a temporary file that are complete."""
    while len(header := file.read(_HEADER.size)) == _HEADER.size:
        stamp, count = _HEADER.unpack(header)
        data = file.read(16 * count)
        if len(data) == 16 * count:
            points = np.frombuffer(data, "<f4", 3 * count).reshape(-1, 3)
            yield StampedCloud(stamp, points, np.frombuffer(data, "<u4", offset=12 * count))


def _decode(path: str, metadata: str, spool: str, limit: int, *, is_osf: bool) -> _Decoded:
    """Write the sweeps of a file to a temporary file, until it has more than `limit` bytes."""
    samples: list[tuple[int, NDArray[np.float32], NDArray[np.float32]]] = []
    problem, luts = "", {}
    with open(spool, "wb") as file:
        try:
            for frame, info in _osf_frames(path) if is_osf else _pcap_frames(path, metadata, samples):
                if info.sn not in luts:
                    luts[info.sn] = _lookup(info)
                _write_sweep(file, frame, luts[info.sn])
                if file.tell() > limit:
                    raise ValueError(f"its sweeps take more than {limit >> 20} MiB")
        except MemoryError:
            raise
        except Exception as error:  # the library fails in many ways on damaged files
            problem = one_line(error)[-200:]
    rows = [np.concatenate([rate, force]) for _, rate, force in samples]
    stamps = np.array([stamp for stamp, _, _ in samples], np.int64)
    return _Decoded(np.array(rows, np.float64).reshape(-1, 6), stamps, problem)


def _library() -> Any:
    return importlib.import_module("ouster.sdk")  # its types are not exported


def _lookup(info: Any) -> Any:
    return _library().core.XYZLut(info, use_extrinsics=False)


def _osf_frames(path: str) -> Iterator[tuple[Any, Any]]:
    for frames in _library().open_source(path, sensor_idx=0):
        for frame in frames:
            if frame is not None:
                yield frame, frame.sensor_info


def _pcap_frames(path: str, metadata: str, samples: list[Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the frames of a capture, and add the samples of its IMU to `samples`."""
    core = _library().core
    source = _library().open_packet_source(path, meta=[metadata])
    info = source.sensor_info[0]
    batch, frame, count = core.FrameBatcher(info), core.LidarFrame(info), 0
    for _, packet in source:
        if isinstance(packet, core.ImuPacket):
            samples += zip(packet.timestamp().astype(np.int64), packet.gyro(), packet.accel(), strict=True)
        elif isinstance(packet, core.LidarPacket):
            count += 1
            if batch(packet, frame):
                yield frame, info
                frame = core.LidarFrame(info)
    if count:
        yield frame, info
    else:
        name = Path(metadata).name
        raise ValueError(f"no packet in it is of the sensor, the size and the UDP port that {name} describes")


def _write_sweep(file: BinaryIO, frame: Any, lookup: Any) -> None:
    """Write stamp, number of points, points [m] and times [ns] of the columns that have arrived."""
    is_valid = (np.asarray(frame.status) & 1).astype(np.bool_)
    if not is_valid.any():
        return
    ranges, stamps = np.asarray(frame.field("RANGE")), np.asarray(frame.timestamp).astype(np.int64)
    start = int(stamps[is_valid].min())
    hit = (ranges > 0) & is_valid
    times = np.broadcast_to(np.clip(stamps - start, 0, 2**32 - 1).astype("<u4"), ranges.shape)[hit]
    points = np.ascontiguousarray(lookup(frame)[hit], "<f4")
    file.write(_HEADER.pack(start, len(points)) + points.tobytes() + times.tobytes())
