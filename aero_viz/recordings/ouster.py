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
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_planner.quaternions import quaternion_of_matrix
from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.input_limits import expansion_limit
from aero_viz.reader_process import Limits, ReaderProcess
from aero_viz.recordings.bag_file import Mounting, one_line
from aero_viz.recordings.cloud_files import StampedCloud
from aero_viz.recordings.imu_messages import ImuRows
from aero_viz.recordings.pcap import ETHERNET, PCAP_MAGICS, frames, udp_payloads, write_ethernet
from aero_viz.recordings.sensors import choose_sensor

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
    extrinsic: NDArray[np.float64]
    """Pose of the sensor in the body's frame [4, 4]."""
    notice: str
    """Sentence on the sensors that are left out; empty if there are none."""


@dataclass
class OusterSensor:
    """The sensor of a capture that is played."""

    wanted: str | None
    """See `choose_sensor`."""
    mounting: Mounting | None = None
    """Filled while the sweeps are read."""
    notice: str = ""
    """Sentence on the sensors that are left out, filled likewise."""


def find_metadata(path: Path, wanted: str | None = None) -> Path | None:
    """Return the file next to a capture that holds the metadata of its sensor; None if there is none.

    Of several, it is the one whose name shares the longest prefix with that of the capture. JSON files that share no
    prefix, or are not metadata of an Ouster, are skipped, and so are those that do not hold the wanted text, which may
    be a serial number, in their name or content.
    """
    files = [file for file in path.parent.glob("*.json") if file.is_file()]
    common = {
        file: sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(file.name, path.name, strict=False)))
        for file in files
    }
    for file in sorted(files, key=lambda file: (-common[file], file.name)):
        with open_user_file(file) as opened:
            content = opened.read(_METADATA_MAX)
        is_wanted = wanted is None or wanted in file.name or wanted.encode() in content
        if common[file] and _KEY in content and is_wanted:
            return file
    return None


def ouster_sweeps(path: Path, imu: ImuRows, sensor: OusterSensor, *, is_osf: bool) -> Iterator[StampedCloud]:
    """Yield the sweeps of a sensor, and fill `imu` with its samples and `sensor` before the first of them.

    The first returns are used.

    Raises:
        UserError: ouster-sdk is not installed, the metadata of the sensor are missing, or there is no sweep.
        EOFError: the file is truncated.
        ValueError: it is damaged.
    """
    if importlib.util.find_spec("ouster") is None:
        raise UserError(f"{path} holds data of an Ouster, which ouster-sdk decodes: {INSTALL}")
    metadata = None if is_osf else find_metadata(path, sensor.wanted)
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
            file = path
            if not is_osf and not _is_ethernet(path):  # the library knows no other link
                file = Path(folder) / "ethernet.pcap"
                write_ethernet(path, file)
            decoded = process(_decode, str(file), str(metadata), str(spool), limit, sensor.wanted, is_osf=is_osf)
            problem, sensor.notice = decoded.problem, decoded.notice
            sensor.mounting = _mounting(decoded.extrinsic)
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


def _is_ethernet(path: Path) -> bool:
    first = next(frames(path), None)
    with open_user_file(path) as file:
        return first is None or (first.link == ETHERNET and not file.read(4).startswith(PCAP_MAGICS[-1]))


def _mounting(pose: NDArray[np.float64]) -> Mounting | None:
    """Return the mounting in the metadata, None if there is none."""
    is_rigid = abs(np.linalg.det(pose[:3, :3]) - 1.0) < 1e-3
    if not is_rigid or not np.isfinite(pose).all() or np.allclose(pose, np.eye(4), atol=1e-6):
        return None
    place = " ".join(f"{value:g}" for value in pose[:3, 3])
    notice = f"the sensor is mounted as its metadata say, at x y z {place} m; --extrinsic replaces this"
    return Mounting(pose[:3, 3].copy(), quaternion_of_matrix(pose[:3, :3]), notice)


def _decode(path: str, metadata: str, spool: str, limit: int, wanted: str | None, *, is_osf: bool) -> _Decoded:
    """Write the sweeps of a file to a temporary file, until it has more than `limit` bytes."""
    samples: list[tuple[int, NDArray[np.float32], NDArray[np.float32]]] = []
    problem, luts, notice, extrinsic = "", {}, "", np.eye(4)
    with open(spool, "wb") as file:
        try:
            number = 0
            if is_osf:
                number, notice = _choose_osf_sensor(path, wanted)
            for frame, info in _osf_frames(path, number) if is_osf else _pcap_frames(path, metadata, samples):
                if info.sn not in luts:
                    luts[info.sn], extrinsic = _lookup(info), _pose_in_body(info)
                _write_sweep(file, frame, luts[info.sn])
                if file.tell() > limit:
                    raise ValueError(f"its sweeps take more than {limit >> 20} MiB")
        except MemoryError:
            raise
        except Exception as error:  # the library fails in many ways on damaged files
            problem = one_line(error)[-200:]
    rows = [np.concatenate([rate, force]) for _, rate, force in samples]
    stamps = np.array([stamp for stamp, _, _ in samples], np.int64)
    return _Decoded(np.array(rows, np.float64).reshape(-1, 6), stamps, problem, extrinsic, notice)


def _library() -> Any:
    return importlib.import_module("ouster.sdk")  # its types are not exported


def _lookup(info: Any) -> Any:
    return _library().core.XYZLut(info, use_extrinsics=False)


def _pose_in_body(info: Any) -> NDArray[np.float64]:
    pose = getattr(info, "sensor_to_body", None)  # "extrinsic" before ouster-sdk 1.0
    return np.array(info.extrinsic if pose is None else pose, np.float64)


def _choose_osf_sensor(path: str, wanted: str | None) -> tuple[int, str]:
    """Return the number of the sensor to play, and a notice on the others."""
    names = [f"{info.prod_line} {info.sn}" for info in _library().open_source(path).sensor_info]
    if len(names) < 2 and wanted is None:
        return 0, ""
    chosen, notice = choose_sensor(dict.fromkeys(names), wanted, Path(path))
    return names.index(chosen), notice


def _osf_frames(path: str, number: int) -> Iterator[tuple[Any, Any]]:
    for group in _library().open_source(path, sensor_idx=number):
        for frame in group:
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
