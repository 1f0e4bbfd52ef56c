"""Packets of Velodyne's sensors, decoded by velodyne-decoder."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from aero_planner.user_file import open_user_file
from aero_viz.extras import from_extra
from aero_viz.recordings.bag_file import one_line
from aero_viz.recordings.cloud_files import StampedCloud

VELODYNE_SIZE = 1206
"""Length of a packet [bytes]."""
VELODYNE_POINTS = 12 * 32
"""Points of a packet."""
_TIME_MAX = 2**32 - 1  # [ns]


def is_velodyne(payload: bytes) -> bool:
    """Return True for a packet of points of a Velodyne."""
    return len(payload) == VELODYNE_SIZE and payload[:2] == b"\xff\xee"


def velodyne_sweeps(path: Path, packets: Iterable[tuple[int, bytes]]) -> Iterator[StampedCloud]:
    """Yield the sweeps in the packets of a Velodyne.

    Args:
        path: what they are from.
        packets: times of capture [ns] and packets of one sensor.

    Raises:
        UserError: velodyne-decoder is not installed.
        ValueError: the capture is damaged.
    """
    with from_extra("formats", f"{path} and other captures of a Velodyne"):
        import velodyne_decoder as decoder
    config = decoder.Config()
    config.timestamp_first_packet = True
    with contextlib.suppress(Exception), open_user_file(path) as file:  # only an HDL-64E has them in its packets
        config.model, config.calibration = decoder.hdl64e.detect_hdl64e(file)
    stream = decoder.StreamDecoder(config)
    for result in _decoded(stream, packets):
        if result is not None:
            stamp, points = result
            yield _sweep(stamp, points, decoder.PointField.time)


def _decoded(stream: Any, packets: Iterable[tuple[int, bytes]]) -> Iterator[Any]:
    for time, packet in packets:
        try:
            yield stream.decode(1e-9 * time, packet)  # type: ignore[arg-type]
        except Exception as error:  # the decoder fails in many ways on damaged packets
            raise ValueError(f"damaged ({one_line(error)}): only the data before it is used") from error
    with contextlib.suppress(Exception):
        yield stream.finish()


def _sweep(stamp: Any, points: Any, time_column: int) -> StampedCloud:
    table: Any = np.asarray(points)
    offsets = table[:, time_column].astype(np.float64)
    start = float(offsets.min()) if len(offsets) else 0.0
    host = float(getattr(stamp, "host", stamp))
    if not math.isfinite(host + start):
        raise ValueError("damaged, a time is not finite: only the data before it is used")
    times = np.clip(np.round(1e9 * (offsets - start)), 0, _TIME_MAX).astype(np.uint32)
    return StampedCloud(round(1e9 * (host + start)), table[:, :3].astype(np.float32), times)
