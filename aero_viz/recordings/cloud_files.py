"""Clouds that are not in bags, as a bag with one topic of PointCloud2: files of points, and decoded sensor packets."""

from __future__ import annotations

import tempfile
from abc import abstractmethod
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_viz.recordings.bag_file import HEAD_BYTES, BagFile, Channel, Message
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2
from aero_viz.scenes.map_decoders import decode
from aero_viz.scenes.map_files import read_points

__all__ = ["CLOUD_SUFFIXES", "CloudFiles", "CloudSequence", "PacketClouds", "StampedCloud"]

CLOUD_SUFFIXES = (".pcd", ".ply", ".las", ".laz", ".npy", ".bin")
"""Names of files that hold one cloud each. KITTI's .bin has rows of four float32: x, y, z, intensity."""
_FRAME = "lidar"
_FAR = 5_000.0
"""A cloud whose centre is farther from the origin than this is in map coordinates and is moved to the origin [m]."""
_KITTI_ROW = 16
_FEET = {9002: 0.3048, 9003: 1200 / 3937}
"""GeoTIFF codes of linear units: the international foot and the US survey foot [m]."""
_UNIT_KEYS = (3076, 4099)  # ProjLinearUnitsGeoKey, VerticalUnitsGeoKey


class StampedCloud(NamedTuple):
    """A sweep."""

    stamp: int
    """[ns]."""
    points: NDArray[np.float32]
    """[P, 3] [m]."""
    times: NDArray[np.uint32] | None
    """Time of each point after the stamp [P] [ns]."""


class CloudSequence(BagFile):
    """Clouds behind the interface of a bag. The position of a message is the number of its cloud.

    Args:
        path: file or folder that the user named.
        topic: topic of the clouds.
    """

    def __init__(self, path: Path, topic: str) -> None:
        super().__init__(path)
        self._channel = self.channels[0] = Channel(topic, POINT_CLOUD2, "cdr")
        self.notices: list[str] = []
        """What was assumed, one sentence each."""

    @abstractmethod
    def _index(self) -> Iterator[tuple[int, int]]:
        """Yield stamp [ns] and number of points of every cloud."""

    @abstractmethod
    def _load(self, index: int) -> StampedCloud:
        """Return a cloud. Raises ValueError if it is damaged."""

    def scan(self, types: Collection[str]) -> Iterator[Message]:
        for index, (stamp, count) in enumerate(self._index()):
            if POINT_CLOUD2 not in types:
                yield Message(self._channel, stamp, index, 0, b"")
                continue
            whole = encode_point_cloud2(np.zeros((count, 3), np.float32), stamp, _FRAME)
            yield Message(self._channel, stamp, index, len(whole), whole[:HEAD_BYTES])

    def read(self, position: int) -> bytes:
        cloud = self._load(position)
        return encode_point_cloud2(cloud.points, cloud.stamp, _FRAME, times=cloud.times)


class CloudFiles(CloudSequence):
    """One cloud per file.

    Args:
        path: the folder, or the only file.
        files: files in the order of time.
        stamps: their stamps [ns].
    """

    def __init__(self, path: Path, files: list[Path], stamps: list[int]) -> None:
        super().__init__(path, "/points")
        self._files, self._stamps = files, stamps
        # The first file is decoded with limits on memory and time. The others are of the same make, and a process for
        # each of them would take longer than a sweep.
        first = _read_points(files[0], apart=True)
        centre = np.median(first, axis=0) if len(first) else np.zeros(3)
        self._offset = np.round(centre) if np.abs(centre).max() > _FAR else np.zeros(3)
        if self._offset.any():
            x, y, z = self._offset
            self.notices.append(f"the cloud is in map coordinates: ({x:.0f}, {y:.0f}, {z:.0f}) m are subtracted")
        unit = _las_unit(files[0])
        if unit != 1.0:
            self.notices.append(f"coordinates in feet are converted to metres, x {unit:.7f}")
        # The number of points only has to be more than zero before a file is read; most headers are not comparable.
        self._count = max(len(first), 1)

    def _index(self) -> Iterator[tuple[int, int]]:
        return iter([(stamp, self._count) for stamp in self._stamps])

    def _load(self, index: int) -> StampedCloud:
        points = _read_points(self._files[index], apart=len(self._files) == 1) - self._offset
        return StampedCloud(self._stamps[index], points.astype(np.float32), None)

    def close(self) -> None:
        """Do nothing: no file stays open."""


def _read_points(path: Path, *, apart: bool) -> NDArray[np.float64]:
    if path.suffix.lower() != ".bin":
        return (read_points(path) if apart else decode(path, "points")) * _las_unit(path)
    data = path.read_bytes()
    if not data or len(data) % _KITTI_ROW:
        raise ValueError(f"{path} is not a KITTI cloud: its {len(data)} bytes are no rows of {_KITTI_ROW}")
    return np.frombuffer(data, "<f4").reshape(-1, 4)[:, :3].astype(np.float64)


def _las_unit(path: Path) -> float:
    """Return the length of the unit of a LAS or LAZ file [m], 1 for every other file and where it is not known."""
    if path.suffix.lower() not in (".las", ".laz"):
        return 1.0
    import laspy

    with laspy.open(path) as reader:
        for record in reader.header.vlrs:
            if record.record_id == 34735:  # GeoKeyDirectoryTag: rows of key, location, count, value
                rows = np.frombuffer(record.record_data_bytes()[8:], "<u2")
                for key, location, _, value in rows[: len(rows) // 4 * 4].reshape(-1, 4).tolist():
                    if key in _UNIT_KEYS and location == 0 and value in _FEET:
                        return _FEET[value]
            elif record.record_id == 2112:  # OGC WKT
                text = record.record_data_bytes().decode(errors="replace").lower()
                if "us survey foot" in text or "foot_us" in text:
                    return _FEET[9003]
                if '"foot"' in text or "international foot" in text:
                    return _FEET[9002]
    return 1.0


class PacketClouds(CloudSequence):
    """Sweeps decoded from packets once, and kept in a temporary file until `close`.

    Args:
        path: the file of packets.
        topic: topic of the clouds.
        sweeps: the sweeps; all are taken at once.
    """

    def __init__(self, path: Path, topic: str, sweeps: Iterable[StampedCloud]) -> None:
        super().__init__(path, topic)
        self._spool = tempfile.TemporaryFile(prefix="aero-viz-")  # noqa: SIM115
        self._rows: list[tuple[int, int, int, bool]] = []  # stamp [ns], offset in the spool, points, times
        for sweep in sweeps:
            self._rows.append((sweep.stamp, self._spool.tell(), len(sweep.points), sweep.times is not None))
            self._spool.write(np.ascontiguousarray(sweep.points, "<f4").tobytes())
            if sweep.times is not None:
                self._spool.write(np.ascontiguousarray(sweep.times, "<u4").tobytes())

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
