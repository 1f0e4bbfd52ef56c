"""The drone's flight log: an MCAP file that `aero-viz play`, Foxglove and RViz open.

Written in chunks of at most a second, each forced to the disk: a crash or a loss of power costs the last second.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np

from aero_planner.config import PlannerConfig
from aero_planner.config.file import format_config
from aero_planner.mailbox import Mailbox
from aero_planner.onboard import ros_messages as messages
from aero_planner.onboard.observer import Observer, PlanRecord
from aero_planner.onboard.point_source import PointPacket
from aero_planner.onboard.safety_machine import Change
from aero_planner.onboard.settings import OnboardConfig, format_onboard
from aero_planner.onboard.vehicle_link import VehicleSample
from aero_planner.quaternions import quaternion_from_angles, rotate

__all__ = ["FlightLog"]

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 4 << 20
_FLUSH_PERIOD = 1.0
"""Wall time between two chunks [s]."""
_WAITING = 1000
"""Items that may wait for the disk; some ten seconds' worth."""
_POSE_SPACING = 0.018
"""Least time between two poses [s]; `play` makes a tick of each."""
_LINES_SPACING = 0.098
"""Least time between two plans that are logged with guides and rollouts [s], some 30 kB each time."""


class FlightLog(Observer):
    """Writes what the node saw and did; a thread of its own does the work.

    Topics: /odometry and /tf, every state up to 50 per second; /sweep, raw points in the body frame with a time each,
    not yet moved by the flight; /plan and /plan/best of every plan, /plan/guides and /plan/rollouts up to ten times per
    second; /safety, every transition. Attachments hold both configurations. Times are wall time, taken from the clock
    at opening.

    Args:
        path: file to write; where the name is taken, one with a number: no flight replaces another.
        planner, onboard: configurations that the node flies with.
        clock: host time [s].

    Raises:
        ImportError: the `mcap` package is missing; names the extra.
        OSError: the file can't be written.

    Attributes:
        path: of the file.
        failed: whether the disk took no more; the file ends there.
    """

    def __init__(
        self,
        path: str | Path,
        planner: PlannerConfig,
        onboard: OnboardConfig,
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise ImportError(
                "the flight log needs the package mcap, which is not installed; run: pip install 'aero-planner[log]'."
            ) from error
        self.failed = False
        self._epoch = time.time() - clock()
        self._period = onboard.lidar.sweep_period
        lidar = onboard.lidar
        self._mount = quaternion_from_angles(lidar.mount_roll, lidar.mount_pitch, lidar.mount_yaw)
        self._place = np.array([lidar.mount_x, lidar.mount_y, lidar.mount_z])
        self._channels: dict[str, int] = {}
        self._packets: list[PointPacket] = []
        self._pose_time = self._lines_time = -np.inf
        self._file = _create(Path(path))
        self.path = Path(self._file.name)
        self._writer: Any = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="aero-planner")
        stamp = self._stamp(clock())
        for name, text in (("config_0.yaml", format_config(planner)), ("onboard.yaml", format_onboard(onboard))):
            self._writer.add_attachment(stamp, stamp, name, "application/yaml", text.encode())
        self._flush()
        self._box: Mailbox[Any] = Mailbox(self._write, capacity=_WAITING, name="aero-planner-log", at_end=self._finish)

    @property
    def dropped(self) -> int:
        """States, packets and plans that the disk was too slow for."""
        return self._box.dropped

    # --- called by the node -----------------------------------------------------------------------------------------

    def plan(self, record: PlanRecord) -> None:
        """Log a plan."""
        self._box.put(record)

    def change(self, change: Change) -> None:
        """Log a transition."""
        self._box.put(change)

    def sample(self, sample: VehicleSample) -> None:
        """Log a state."""
        self._box.put(sample)

    def points(self, packet: PointPacket) -> None:
        """Log points."""
        self._box.put(packet)

    def close(self) -> None:
        """Finish the file; with a disk that is too slow that is left to the log's thread, as far as it gets."""
        if not self._box.close():
            _log.error(
                "the flight log %s may lack its end: the disk is too slow; %d items are dropped",
                self.path, self.dropped,
            )  # fmt: skip

    # --- the thread -------------------------------------------------------------------------------------------------

    def _write(self, item: PlanRecord | Change | VehicleSample | PointPacket) -> None:
        if self.failed:
            return
        try:
            if isinstance(item, PlanRecord):
                self._write_plan(item)
            elif isinstance(item, Change):
                stamp = self._stamp(item.time)
                self._add(messages.safety_change(item, stamp), stamp)
            elif isinstance(item, VehicleSample):
                self._write_pose(item)
            else:
                self._take(item)
            if time.monotonic() - self._flushed > _FLUSH_PERIOD:
                self._flush()
        except OSError as error:
            self.failed = True
            _log.error("the flight log %s ends here: %s", self.path, error.strerror or error)

    def _finish(self) -> None:
        try:
            if not self.failed:
                self._write_sweep()
                self._writer.add_metadata("flight_log", {"dropped": str(self.dropped)})
                self._writer.finish()
        except OSError as error:
            _log.error("the flight log %s has no proper end: %s", self.path, error.strerror or error)
        finally:
            self._file.close()

    def _write_plan(self, record: PlanRecord) -> None:
        lines = record.time - self._lines_time >= _LINES_SPACING
        if lines:
            self._lines_time = record.time
        stamp = self._stamp(record.time)
        for message in messages.plan_messages(record.plan, stamp, plan_ms=record.plan_ms, lines=lines):
            self._add(message, stamp)

    def _write_pose(self, sample: VehicleSample) -> None:
        if sample.time - self._pose_time < _POSE_SPACING:
            return
        self._pose_time = sample.time
        stamp = self._stamp(sample.time)
        for message in messages.pose_messages(sample.state, stamp):
            self._add(message, stamp)

    def _take(self, packet: PointPacket) -> None:
        """Gather points until they make up a sweep."""
        if self._packets and packet.times.max() - self._packets[0].times.min() > self._period:
            self._write_sweep()
        self._packets.append(packet)

    def _write_sweep(self) -> None:
        if not self._packets:
            return
        points = np.concatenate([packet.points for packet in self._packets])
        times = np.concatenate([packet.times for packet in self._packets])
        self._packets = []
        first = float(times.min())
        body = (rotate(self._mount, points) + self._place).astype(np.float32)
        stamp = self._stamp(first)
        after = np.rint(1e9 * (times - first)).clip(0, 2**32 - 1).astype(np.uint32)
        self._add(messages.sweep(body, stamp, times=after), stamp)

    def _add(self, message: messages.Encoded, stamp: int) -> None:
        topic, kind, data = message
        if topic not in self._channels:
            schema = self._writer.register_schema(kind, "ros2msg", messages.DEFINITIONS[kind].encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        self._writer.add_message(self._channels[topic], stamp, data, stamp)

    def _stamp(self, host_time: float) -> int:
        return round(1e9 * (self._epoch + host_time))

    def _flush(self) -> None:
        self._writer.flush()
        self._file.flush()
        os.fsync(self._file.fileno())
        self._flushed = time.monotonic()


def _create(path: Path) -> BufferedWriter:
    """Open a new file; where the name is taken, the first one that is free with a number behind it."""
    place, number = path, 0
    while True:
        try:
            return place.open("xb")
        except FileExistsError:
            number += 1
            place = path.with_stem(f"{path.stem}_{number}")
