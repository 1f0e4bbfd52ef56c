"""Recording of a stream: its messages as they came, and the inputs and the plan of every tick, exactly."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import time
from collections import deque
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from aero_planner.config import DroneConfig
from aero_planner.config.file import format_config
from aero_planner.mailbox import Mailbox
from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.ros_messages import WORLD, goal_message, plan_messages
from aero_planner.output_files import open_alone
from aero_viz.errors import UserError
from aero_viz.live.source import Tick
from aero_viz.live.stream import LiveMessage, Stream
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, encode_point_cloud2
from aero_viz.recordings.ros_messages import message_definition
from aero_viz.session.frame import Frame

TICK_TOPIC, SWEEP_TOPIC = "/aero_viz/tick", "/aero_viz/sweep"
TICK = "aero_viz_msgs/msg/Tick"
TICK_DEFINITION = """\
# Inputs of the planner at one tick, exactly as they were used.
float64 time           # time of the source [s]
float64[3] position    # [m], world frame
float64[3] velocity    # [m/s], world frame
float64[4] quaternion  # w, x, y, z, body to world
float64[3] goal        # [m], world frame
float64 cloud_age      # age of the newest sweep [s]
uint32 first           # number of the first sweep of the cloud, counted on /aero_viz/sweep
float64[] arrivals     # time [s] and place [m] at which each sweep was complete: four numbers each
"""
SETTINGS = "live.json"
"""Name of the attachment with the conditions of the plans."""
_CHUNK = 1 << 20
_FLUSH_PERIOD = 1.0  # [s]; a killed process loses no more
_WAITING_MAX = 4096
"""Messages that may wait for the disk: several seconds."""


class TickRecord(NamedTuple):
    """A tick of a recording."""

    time: float
    values: NDArray[np.float64]
    """Position, velocity, quaternion, goal and the age of the cloud, shape [14]."""
    first: int
    """Number of the first sweep of its cloud."""
    arrivals: NDArray[np.float64]
    """Time and place of each sweep, shape [n, 4]."""


class Recorder:
    """Writes a stream and its plans to an MCAP file, on threads of their own: nobody waits for the disk.

    The file begins with what the stream has kept, so that it holds all that the first plan was made from.

    Args:
        path: file to write; an existing one is replaced.
        stream: the messages.
        seed: seed of the planner's noise.
        failed: called with a sentence if the file cannot be written any more.

    Raises:
        UserError: the file cannot be written.
    """

    sink: Mailbox[Frame]
    """Delivers the ticks to `put`."""

    def __init__(self, path: str | Path, stream: Stream, *, seed: int, failed: Callable[[str], None]) -> None:
        self.path = Path(path)
        self.ticks = 0
        """Number of ticks written so far."""
        self._failed, self._has_failed, self._seed = failed, False, seed
        self._channels: dict[tuple[str, str], int] = {}
        self._config: DroneConfig | None = None
        self._goal: NDArray[np.float64] | None = None
        self._window: deque[NDArray[np.float32]] = deque()
        self._first = 0
        try:
            self._file = open_alone(self.path)
            self._writer = Writer(self._file, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
            self._writer.start(profile="ros2", library=f"aero-viz {importlib.metadata.version('aero-viz')}")
        except OSError as error:
            raise UserError(f"Cannot write the recording {path}: {error.strerror or error}.") from error
        self._flushed = time.monotonic()
        # One thread writes: whoever delivers hands over.
        self._work: Mailbox[Callable[[], None]] = Mailbox(
            self._run, capacity=_WAITING_MAX, name="aero-viz-recorder", low_priority=True
        )
        self._end = stream.listen(lambda message: self._hand_over(lambda: self._write_message(message)), from_kept=True)

    def put(self, frame: Frame) -> None:
        """Write a tick, which must be one of a stream."""
        self._hand_over(lambda: self._write_tick(frame))

    def _hand_over(self, work: Callable[[], None]) -> None:
        self._work.put(work)
        if self._work.dropped and not self._has_failed:
            self._fail("the disk is too slow for the stream")

    def _run(self, work: Callable[[], None]) -> None:
        if self._has_failed:
            return
        try:
            work()
            if time.monotonic() - self._flushed > _FLUSH_PERIOD:
                self._writer.flush()
                self._file.flush()
                self._flushed = time.monotonic()
        except OSError as error:
            self._fail(error.strerror or str(error))

    def _fail(self, reason: str) -> None:
        self._has_failed = True
        self._failed(f"The recording {self.path} ends here: {reason}.")

    def _write_message(self, message: LiveMessage) -> None:
        self._add(message.topic, message.type, message.data, message.time)

    def _write_tick(self, frame: Frame) -> None:
        tick: Any = None if frame.checkpoint is None else frame.checkpoint.source
        assert isinstance(tick, Tick)
        stamp = tick.arrival
        if frame.config is not self._config:
            self._config = frame.config
            name = f"config_{frame.config_version}.yaml"
            self._attach(name, "application/yaml", format_config(frame.config), stamp)
        for sweep in self._take_over(list(tick.sweeps)):
            self._add(SWEEP_TOPIC, POINT_CLOUD2, encode_point_cloud2(sweep, stamp, WORLD), stamp)
        self._add(TICK_TOPIC, TICK, encode_tick(tick, self._first), stamp)
        if self._goal is None or not np.array_equal(self._goal, tick.goal):
            self._goal = tick.goal
            message = goal_message(frame.observation.goal, stamp)
            self._add(message.topic, message.kind, message.data, stamp)
        plan_ms = float(frame.timings_ms.get("plan", 0.0))
        for message in plan_messages(frame.plan, stamp, plan_ms=plan_ms, config_version=frame.config_version):
            self._add(message.topic, message.kind, message.data, stamp)
        self.ticks += 1

    def _take_over(self, sweeps: list[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        """Make these sweeps those of the present cloud; return those that are new."""
        while self._window and (not sweeps or self._window[0] is not sweeps[0]):
            self._window.popleft()
            self._first += 1
        added = sweeps[len(self._window) :]
        self._window.extend(added)
        return added

    def _add(self, topic: str, kind: str, data: bytes, stamp: int) -> None:
        channel = self._channels.get((topic, kind))
        if channel is None:
            definition = TICK_DEFINITION if kind == TICK else DEFINITIONS.get(kind) or message_definition(kind) or ""
            schema = self._writer.register_schema(kind, "ros2msg", definition.encode())
            channel = self._channels[topic, kind] = self._writer.register_channel(topic, "cdr", schema)
        self._writer.add_message(channel, stamp, data, stamp)

    def _attach(self, name: str, media_type: str, text: str, stamp: int) -> None:
        self._writer.add_attachment(stamp, stamp, name, media_type, text.encode())

    def close(self, *, dropped: int = 0) -> None:
        """Write what waits, and finish the file.

        Args:
            dropped: number of ticks that were not handed over.
        """
        self._end()
        self._work.finish(timeout=30.0)
        with contextlib.suppress(OSError):
            if not self._has_failed:
                settings = {"seed": self._seed, "dropped": dropped}
                self._attach(SETTINGS, "application/json", json.dumps(settings), 0)
                self._writer.finish()
        self._file.close()


@cache
def _store() -> Typestore:
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TICK_DEFINITION, TICK))
    return store


def encode_tick(tick: Tick, first: int) -> bytes:
    """Return a tick as CDR; `first` is the number of the first sweep of its cloud."""
    arrivals = [(a.time, *a.position) for a in tick.sweeps.arrivals if a is not None]
    state = tick.state
    parts = (state.position, state.velocity, state.quaternion, tick.goal)
    message = _store().types[TICK](
        tick.time,
        *(np.asarray(part, np.float64) for part in parts),
        tick.cloud_age,
        first,
        np.array(arrivals, np.float64).ravel(),
    )
    return bytes(_store().serialize_cdr(message, TICK))


def decode_tick(data: bytes) -> TickRecord:
    """Return a tick from CDR. Raises ValueError if it is damaged."""
    try:
        message: Any = _store().deserialize_cdr(data, TICK)
    except Exception as error:  # the decoders of rosbags fail in many ways
        raise ValueError("a tick is damaged") from error
    parts = (message.position, message.velocity, message.quaternion, message.goal, [message.cloud_age])
    values = np.concatenate([np.asarray(part, np.float64) for part in parts])
    arrivals = np.asarray(message.arrivals, np.float64)
    if not np.isfinite([message.time, *values, *arrivals]).all() or len(arrivals) % 4:
        raise ValueError("a tick has impossible numbers")
    return TickRecord(float(message.time), values, int(message.first), arrivals.reshape(-1, 4))
