"""Clouds that are not in bags, as a bag with one topic of PointCloud2: files of points, and decoded sensor packets."""

from __future__ import annotations

import heapq
import shutil
import tempfile
from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_viz.errors import UserError
from aero_viz.input_limits import LimitExceeded, ReadingBudget
from aero_viz.point_times import point_times
from aero_viz.recordings.bag_file import HEAD_BYTES, BagFile, Channel, Message, Mounting
from aero_viz.recordings.bin_files import find_layout, parse_columns, read_bin
from aero_viz.recordings.cloud_times import STAMP_END, number_in_name
from aero_viz.recordings.imu_messages import IMU_TYPE, ImuRows
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2, replace_stamp, valid_points
from aero_viz.scenes.decoder_checks import check_place
from aero_viz.scenes.decoding_process import DecodingProcess
from aero_viz.scenes.las import LasUnits
from aero_viz.scenes.map_files import read_timed_points
from aero_viz.scenes.text_cloud import TEXT_SUFFIXES, find_text_layout

CLOUD_SUFFIXES = (".pcd", ".ply", ".las", ".laz", ".e57", ".npy", ".bin")
"""Names of files that hold one cloud each. A .bin has rows of numbers: see `bin_files`. Texts may hold clouds, too."""
_FRAME = "lidar"
_FAR = 5_000.0
"""A cloud whose centre is farther from the origin than this is in map coordinates and is moved to the origin [m]."""
_TRIED = 5
"""Largest number of damaged files at the start of a folder."""


class StampedCloud(NamedTuple):
    """A sweep."""

    stamp: int
    """[ns]."""
    points: NDArray[np.float32]
    """[P, 3] [m]."""
    times: NDArray[np.uint32] | NDArray[np.float32] | None
    """Time of each point after the stamp [P], uint32 [ns] or float32 [s]."""


class CloudSequence(BagFile):
    """Clouds behind the interface of a bag. The position of a message is the number of its cloud.

    Args:
        path: file or folder that the user named.
        topic: topic of the clouds.
        size: size of the file, or of all files [bytes].
    """

    def __init__(self, path: Path, topic: str, size: int) -> None:
        super().__init__(path)
        self._size = size
        self._channel = self.channels[0] = Channel(topic, POINT_CLOUD2, "cdr")

    @abstractmethod
    def _index(self) -> Iterator[tuple[int, int]]:
        """Yield stamp [ns] and number of points of every cloud."""

    @abstractmethod
    def _load(self, index: int) -> StampedCloud:
        """Return a cloud. Raises ValueError or UserError if it is damaged."""

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        budget = ReadingBudget(self._size)
        for index, (stamp, count) in enumerate(self._index()):
            if POINT_CLOUD2 not in types:
                yield Message(self._channel, stamp, index, 0, b"")
                continue
            if budget.is_late:
                self.problems.append("too costly to read for its size: only the part read so far is used")
                return
            size, head = _layout(count)
            yield Message(self._channel, stamp, index, size, replace_stamp(head, stamp))

    def read(self, position: int) -> bytes:
        cloud = self._load(position)
        return encode_point_cloud2(cloud.points, cloud.stamp, _FRAME, times=cloud.times)


@lru_cache(maxsize=256)
def _layout(count: int) -> tuple[int, bytes]:
    """Return the size and the head of the message of a cloud with `count` points."""
    whole = encode_point_cloud2(np.zeros((count, 3), np.float32), 0, _FRAME)
    return len(whole), whole[:HEAD_BYTES]


class CloudFiles(CloudSequence):
    """One cloud per file. One process decodes them all, and each within limits on memory and time.

    Args:
        path: the folder, or the only file.
        files: files in the order of time.
        stamps: their stamps [ns].
        suffix: names their format; None takes that of the first file.
        columns: rows of .bin files, see `parse_columns`; None finds them.

    Raises:
        UserError: the first files are all damaged.
    """

    def __init__(
        self,
        path: Path,
        files: list[Path],
        stamps: list[int],
        suffix: str | None = None,
        *,
        columns: str | None = None,
    ) -> None:
        super().__init__(path, "/points", sum(file.stat().st_size for file in files))
        self._files, self._stamps = files, stamps
        self._suffix = suffix or files[0].suffix.lower()
        self._layout = None
        if self._suffix == ".bin":
            self._layout = find_layout(files) if columns is None else parse_columns(columns)
            choice = "as --columns says" if columns else "--columns names others"
            self.notices.append(
                f"the .bin files are read as rows of {self._layout}, of which x, y, z are the first; {choice}"
            )
        self.damage: dict[Path, str] = {}
        """Reasons why files could not be read so far."""
        self._process = DecodingProcess()
        try:
            file, points = self._first_cloud()
            known = points[np.isfinite(points).all(axis=1)]
            centre = np.median(known, axis=0) if len(known) else np.zeros(3)
            check_place(centre, file)
            if self._suffix in TEXT_SUFFIXES:
                self.notices.append(str(find_text_layout(file)))
            is_las = self._suffix in (".las", ".laz")
            units = self._process.las_units(file) if is_las else LasUnits()
        except BaseException:
            self._process.close()
            raise
        self._offset = np.round(centre) if np.abs(centre).max() > _FAR else np.zeros(3)
        if self._offset.any():
            x, y, z = self._offset
            self.notices.append(f"the cloud is in map coordinates: ({x:.0f}, {y:.0f}, {z:.0f}) m are subtracted")
        self.notices += [units.notice] if units.notice else []
        if not units.is_named:
            self.notices.append("the file names no coordinate system: its coordinates are assumed to be metres")
        if (units.horizontal, units.vertical) != (1.0, 1.0):
            heights = f", heights x {units.vertical:.7f}" if units.vertical != units.horizontal else ""
            self.notices.append(f"coordinates in feet are converted to metres, x {units.horizontal:.7f}{heights}")
        # The number of points only has to be more than zero before a file is read; most headers are not comparable.
        self._count = max(len(points), 1)

    def _first_cloud(self) -> tuple[Path, NDArray[np.float64]]:
        """Return the first file that is not damaged, and its points."""
        errors: list[UserError] = []
        for file in self._files[:_TRIED]:
            try:
                return file, self._read_points(file)[0]
            except UserError as error:
                errors.append(error)
        raise errors[0]

    def _index(self) -> Iterator[tuple[int, int]]:
        return iter([(stamp, self._count) for stamp in self._stamps])

    def _load(self, index: int) -> StampedCloud:
        stamp, file = self._stamps[index], self._files[index]
        try:
            table, values = self._read_points(file)
        except UserError as error:
            self.damage[file] = str(error).split(str(file), 1)[-1].strip(": .")
            raise
        with np.errstate(over="ignore", invalid="ignore"):
            points = (table - self._offset).astype(np.float32)
            valid = valid_points(points)
        seconds = None if values is None or not valid.any() else point_times(values[valid], stamp)
        if seconds is None:
            return StampedCloud(stamp, points, None)
        times = np.zeros(len(points), np.float32)
        times[valid] = seconds
        return StampedCloud(stamp, points, times)

    @property
    def parts(self) -> list[Path]:
        return self._files

    def number(self, position: int) -> int | None:
        return number_in_name(self._files[position])

    def _read_points(self, path: Path) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
        """Return points [n, 3] [m] and their times [n] as stored in the file, or None."""
        if self._layout is not None:
            return read_bin(path, self._layout), None
        return read_timed_points(path, self._process, self._suffix)

    def close(self) -> None:
        self._process.close()


class PacketClouds(CloudSequence):
    """Sweeps decoded from packets once, and kept in a temporary file until `close`, and samples of an IMU.

    The temporary file is limited like that of a compressed recording.

    Args:
        path: the file of packets.
        topic: topic of the clouds.
        sweeps: the sweeps; all are taken at once. EOFError says that the file is truncated, and ValueError that it is
            damaged.
        imu: filled while the sweeps are taken; None without an IMU. The position of a sample is -1 - its number.
        mounting: pose of the sensor, where the file has one.
        notice: sentence for the user about the sensor.

    Raises:
        UserError: the temporary folder is too small.
    """

    def __init__(
        self,
        path: Path,
        topic: str,
        sweeps: Iterable[StampedCloud],
        *,
        imu: ImuRows | None = None,
        mounting: Mounting | None = None,
        notice: str = "",
    ) -> None:
        self._imu = imu
        super().__init__(path, topic, path.stat().st_size)
        self.mounting, self.is_of_chosen_sensor = mounting, True
        self.notices += [notice] if notice else []
        self._spool = tempfile.TemporaryFile(prefix="aero-viz-")  # noqa: SIM115
        self._rows: list[tuple[int, int, int, bool]] = []  # stamp [ns], offset in the spool, points, times
        try:
            self._keep(sweeps)
        except EOFError:
            self.truncated = True
        except (ValueError, LimitExceeded) as error:
            self.problems.append(str(error))
        except BaseException:
            self._spool.close()
            raise

    def _keep(self, sweeps: Iterable[StampedCloud]) -> None:
        folder, budget = tempfile.gettempdir(), ReadingBudget(self._size)
        space = shutil.disk_usage(folder).free // 2
        for sweep in sweeps:
            budget.check_time()
            if not 0 <= sweep.stamp < STAMP_END:
                self.damaged += 1
                continue
            parts = [np.ascontiguousarray(sweep.points, "<f4").tobytes()]
            if sweep.times is not None:
                parts.append(np.ascontiguousarray(sweep.times, "<u4").tobytes())
            here = self._spool.tell()
            budget.take_bytes(sum(map(len, parts)))
            if here + sum(map(len, parts)) > space:
                raise UserError(
                    f"{self.path} takes more than the {space >> 20} MiB that may be used in {folder}: set TMPDIR to a "
                    "larger folder."
                )
            self._rows.append((sweep.stamp, here, len(sweep.points), sweep.times is not None))
            self._spool.writelines(parts)

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        samples = self._scan_imu(types) if self._imu is not None and self._imu.stamps else ()
        yield from heapq.merge(super().scan(types), samples, key=lambda message: message.time)

    def _scan_imu(self, types: Collection[str]) -> Iterator[Message]:
        assert self._imu is not None
        channel = self.channels[1] = Channel(self._imu.topic, IMU_TYPE, "cdr")
        for index, stamp in enumerate(self._imu.stamps):
            data = self.read(-1 - index) if IMU_TYPE in types else b""
            if stamp < STAMP_END:
                yield Message(channel, stamp, -1 - index, len(data), data)

    def read(self, position: int) -> bytes:
        if position < 0 and self._imu is not None:
            return self._imu.encode(-1 - position, _FRAME)
        return super().read(position)

    def _index(self) -> Iterator[tuple[int, int]]:
        return ((stamp, count) for stamp, _, count, _ in self._rows)

    def _load(self, index: int) -> StampedCloud:
        stamp, offset, count, is_timed = self._rows[index]
        self._spool.seek(offset)
        points = np.frombuffer(self._spool.read(12 * count), "<f4").reshape(-1, 3)
        times = np.frombuffer(self._spool.read(4 * count), "<u4") if is_timed else None
        return StampedCloud(stamp, points, times)

    def close(self) -> None:
        self._spool.close()
