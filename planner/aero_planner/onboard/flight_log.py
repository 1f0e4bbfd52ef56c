"""The drone's flight log: an MCAP file that `aero-viz play`, Foxglove and RViz open.

Written in chunks of at most one second, each synchronised to the disk, so that a crash or a power failure costs only
the last second.
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
from aero_planner.mission_progress import MissionEvent
from aero_planner.onboard import ros_messages
from aero_planner.onboard.flight_config import format_onboard
from aero_planner.onboard.interfaces import (
    ConfigChange,
    Observation,
    Observer,
    PlanRecord,
    PointPacket,
    VehicleSample,
)
from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.quaternions import quaternion_from_angles, rotate

_log = logging.getLogger(__name__)

_CHUNK_BYTES = 4 << 20
_WAITING = 1000
"""Largest number of items that wait for the disk, those of about ten seconds."""
_POSE_SPACING = 0.018
"""Smallest time between two poses [s]; in `aero-viz play` each pose is a tick."""
_LINES_SPACING = 0.098
"""Smallest time between two plans that are logged with guides and rollouts [s], about 30 kB each."""


class FlightLog(Observer):
    """Writes the inputs and decisions of the node, on its own thread.

    Topics:
        /odometry, /tf: Vehicle states, at most 50 per second.
        /sweep: Raw points in the body frame with a time each, not deskewed.
        /plan, /plan/best: Every plan.
        /plan/guides, /plan/rollouts: Guides and rollouts, at most ten times per second.
        /safety: Every transition of the safety state.
        /mission: Every end of a leg of the mission.

    Attachments hold both configurations, and every later one of the planner. Times are wall time, derived from the
    clock when the file is opened.

    Args:
        path: File to write. If it exists, a number is appended to the name, so that no flight replaces another.
        planner: Configuration of the planner.
        onboard: Configuration of the node.
        clock: Host time [s].
        flush_period: Largest time between two chunks [s].

    Raises:
        ImportError: The `mcap` package is not installed; names the extra to install.
        OSError: The file can't be written.

    Attributes:
        path: Path of the file.
        failed: True if writing has failed; the file ends there.
    """

    def __init__(
        self,
        path: str | Path,
        planner: PlannerConfig,
        onboard: OnboardConfig,
        *,
        clock: Callable[[], float] = time.monotonic,
        flush_period: float = 1.0,
    ) -> None:
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise ImportError(
                "the flight log needs the package mcap, which is not installed; run: pip install mcap."
            ) from error
        self.failed = False
        self._refused = 0
        self._flush_period = flush_period
        self._epoch = ros_messages.wall_time() - clock()
        self._period = onboard.lidar.sweep_period
        lidar = onboard.lidar
        self._mount = quaternion_from_angles(lidar.mount_roll, lidar.mount_pitch, lidar.mount_yaw)
        self._mount_position = np.array([lidar.mount_x, lidar.mount_y, lidar.mount_z])
        self._channels: dict[str, int] = {}
        self._packets: list[PointPacket] = []
        self._pose_time = self._lines_time = -np.inf
        self._file = _create(Path(path))
        self.path = Path(self._file.name)
        self._writer: Any = Writer(self._file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library="aero-planner")
        stamp = self._stamp(clock())
        self._attach(stamp, "onboard.yaml", format_onboard(onboard))
        self._attach_config(stamp, 0, planner)
        self._flush()
        self._mailbox: Mailbox[Observation] = Mailbox(
            self._write, capacity=_WAITING, name="aero-planner-log", low_priority=True, at_end=self._finish
        )

    @property
    def dropped(self) -> int:
        """Number of states, packets and plans that were dropped because the disk was too slow."""
        return self._mailbox.dropped + self._refused

    # --- called by the node ---

    def observe(self, item: Observation) -> None:
        """Log an item."""
        self._refused += not self._mailbox.put(item)

    def close(self, timeout: float = 5.0) -> None:
        """Finish the file. If that takes longer than `timeout` [s], the thread finishes it on its own."""
        if not self._mailbox.finish(timeout):
            _log.error(
                "the end of the flight log %s may be missing: the disk is too slow; %d items were dropped",
                self.path, self.dropped,
            )  # fmt: skip

    # --- the thread ---

    def _write(self, item: Observation) -> None:
        if self.failed:
            return
        try:
            if isinstance(item, PlanRecord):
                self._write_plan(item)
            elif isinstance(item, StateChange):
                stamp = self._stamp(item.time)
                self._add(stamp, ros_messages.safety_change(item, stamp))
            elif isinstance(item, MissionEvent):
                self._add(self._stamp(item.time), ros_messages.mission_event(item))
            elif isinstance(item, ConfigChange):
                self._attach_config(self._stamp(item.time), item.version, item.config)
            elif isinstance(item, VehicleSample):
                self._write_pose(item)
            else:
                self._add_packet(item)
            if time.monotonic() - self._flushed >= self._flush_period:
                self._flush()
        except OSError as error:
            self.failed = True
            _log.error("the flight log %s ends early: %s", self.path, error.strerror or error)

    def _finish(self) -> None:
        try:
            if not self.failed:
                self._write_sweep()
                self._writer.add_metadata("flight_log", {"dropped": str(self.dropped)})
                self._writer.finish()
        except OSError as error:
            _log.error("the flight log %s could not be finished: %s", self.path, error.strerror or error)
        finally:
            self._file.close()

    def _write_plan(self, record: PlanRecord) -> None:
        lines = record.time - self._lines_time >= _LINES_SPACING
        if lines:
            self._lines_time = record.time
        stamp = self._stamp(record.time)
        options = {"plan_ms": record.plan_ms, "lines": lines, "config_version": self._config_version}
        self._add(stamp, *ros_messages.plan_messages(record.plan, stamp, **options))

    def _write_pose(self, sample: VehicleSample) -> None:
        if sample.time - self._pose_time < _POSE_SPACING:
            return
        self._pose_time = sample.time
        stamp = self._stamp(sample.time)
        self._add(stamp, *ros_messages.pose_messages(sample.state, stamp))

    def _add_packet(self, packet: PointPacket) -> None:
        """Collect points until they fill a sweep."""
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
        body = (rotate(self._mount, points) + self._mount_position).astype(np.float32)
        stamp = self._stamp(first)
        offsets = np.rint(1e9 * (times - first)).clip(0, 2**32 - 1).astype(np.uint32)
        self._add(stamp, ros_messages.sweep(body, stamp, times=offsets))

    def _attach_config(self, stamp: int, version: int, config: PlannerConfig) -> None:
        """Attach the configuration of the plans from now on."""
        self._config_version = version
        self._attach(stamp, f"config_{version}.yaml", format_config(config))

    def _attach(self, stamp: int, name: str, text: str) -> None:
        self._writer.add_attachment(stamp, stamp, name, "application/yaml", text.encode())

    def _add(self, stamp: int, *messages: ros_messages.Encoded) -> None:
        for topic, kind, data in messages:
            if topic not in self._channels:
                schema = self._writer.register_schema(kind, "ros2msg", DEFINITIONS[kind].encode())
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
    """Open a new file. If `path` exists, append the first number for which no file exists."""
    candidate, number = path, 0
    while True:
        try:
            return candidate.open("xb")
        except FileExistsError:
            number += 1
            candidate = path.with_stem(f"{path.stem}_{number}")
