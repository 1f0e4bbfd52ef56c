"""A recorded stream as a source: the inputs of every tick as they were, so that the same plans come of them."""

from __future__ import annotations

import bisect
import contextlib
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Arrival, Goal, PlanStatus, Sweeps, VehicleState
from aero_planner.config import DroneConfig
from aero_planner.sweeps import as_constant
from aero_planner.user_file import parse_json
from aero_viz.errors import UserError
from aero_viz.live.record import SETTINGS, SWEEP_TOPIC, TICK, TICK_TOPIC, TickRecord, decode_tick
from aero_viz.logs.log_contents import LogContents, is_flight_log, read_log
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import Plan
from aero_viz.reader_process import Reader
from aero_viz.recordings.bag_file import ChunkPosition
from aero_viz.recordings.mcap_file import McapFile
from aero_viz.recordings.point_cloud2 import read_point_cloud2
from aero_viz.recordings.source import checked_goal
from aero_viz.recordings.storage import readable
from aero_viz.session.source import RecordedPlan, SourceInfo

_PROBED = 4096
"""Messages of a file in which its kind is looked for: it begins with what the stream had kept, and then a tick."""


def is_stream_recording(path: str | Path) -> bool:
    """Return True for an MCAP file of `Recorder`. It may be cut off."""
    if not is_flight_log(path):  # which knows most other files by their summaries
        return False
    try:
        with contextlib.closing(McapFile(Path(path))) as recording:
            for number, _ in enumerate(recording.scan(())):
                if any(channel.topic == TICK_TOPIC for channel in recording.channels.values()):
                    return True
                if number > _PROBED:
                    break
    except Exception:  # a damaged file can fail anywhere in the decoders
        return False
    return False


@lru_cache(maxsize=1)
def _contents(path: str, changed: int) -> LogContents:
    """Return what a recording holds besides its inputs; `play` asks twice, and each time takes a process."""
    return read_log(path)


def recorded_config(path: str | Path) -> DroneConfig | None:
    """Return the configuration with which a recording of `Recorder` begins, None if it has none.

    Raises:
        UserError: it is damaged.
    """
    contents = _contents(str(path), Path(path).stat().st_mtime_ns)
    versions = [int(name[7:-5]) for name in contents.attachments if re.fullmatch(r"config_\d+\.yaml", name)]
    return contents.config(min(versions)) if versions else None


class StreamReplay:
    """Replays the ticks of a recorded stream; see `aero_viz.session.source.Source`.

    With the configuration and the seed of the recording, the plans are those that were made live, bit for bit.

    Args:
        path: file of `Recorder`.
        read: reads the recorded plans; None starts a process for it.

    Raises:
        UserError: it holds no tick, or is damaged.
    """

    def __init__(self, path: str | Path, *, read: Reader | None = None) -> None:
        path = Path(path)
        self._file = McapFile(path)
        self._sweep_places: list[ChunkPosition] = []
        self._ticks: list[TickRecord] = []
        self._stamps: dict[int, float] = {}
        """Time of each tick [s] by that of its messages [ns]."""
        self._damaged = 0
        with readable(path):
            for message in self._file.scan((TICK,)):
                if message.channel.topic == SWEEP_TOPIC:
                    self._sweep_places.append(message.position)
                elif message.channel.topic == TICK_TOPIC:
                    self._add_tick(self._file.read(message.position), message.time)
        if not self._ticks:
            self._file.close()
            raise UserError(f"{path} holds no whole tick of a stream: record it again.")
        times = np.array([tick.time for tick in self._ticks])
        positions = np.array([tick.values[:3] for tick in self._ticks])
        notices = ["Recorded stream: inputs and plans are those of the recording; it is planned again now."]
        plans, problem = self._read_plans(path, read)
        notices += [problem] if problem else []
        if self._damaged:
            notices.append(f"{self._damaged} ticks of the recording are damaged: left out.")
        self._plan_times = [plan.time for plan in plans]
        self._plans = plans
        self.outcome: str | None = None
        self.info = SourceInfo(
            name=path.name,
            closed_loop=False,
            period=float(np.median(np.diff(times))) if len(times) > 1 else 0.05,
            start=positions[0],
            times=times,
            recorded_path=positions,
            recorded_plan=self._plan_at if plans else None,
            notices=tuple(notices),
        )
        self._index = 0
        self._goal: NDArray[np.float64] | None = None
        self._sweep = lru_cache(maxsize=32)(self._read_sweep)
        # The same object as long as the sweeps are the same, as it was live.
        self._cloud = lru_cache(maxsize=2)(self._join)

    def _add_tick(self, data: bytes, stamp: int) -> None:
        try:
            tick = decode_tick(data)
        except ValueError:
            self._damaged += 1
            return
        if self._ticks and tick.time <= self._ticks[-1].time:
            self._damaged += 1
            return
        self._ticks.append(tick)
        self._stamps[stamp] = tick.time

    def _read_plans(self, path: Path, read: Reader | None) -> tuple[list[RecordedPlan], str]:
        """Return the recorded plans, and a sentence if they cannot be read."""
        try:
            contents = read_log(path, read) if read else _contents(str(path), path.stat().st_mtime_ns)
        except UserError as error:
            return [], str(error)
        plans = [
            RecordedPlan(
                self._stamps[plan.stamp],
                plan.path,
                plan.best,
                plan.kinds,
                PlanStatus(plan.status),
                plan.stage2_cost,
                plan.clearance,
            )
            for plan in contents.plans
            if len(plan.path) and plan.stamp in self._stamps
        ]
        configs = sum(name.startswith("config_") for name in contents.attachments)
        seed, dropped = (_setting(contents, name) for name in ("seed", "dropped"))
        sentences = [
            f"The configuration was changed {configs - 1} times; it plays with the first one." if configs > 1 else "",
            f"It was planned with --seed {seed}." if seed else "",
            f"{dropped} ticks were not written, the disk being too slow: later plans differ." if dropped else "",
        ]
        return plans, " ".join(filter(None, sentences))

    def _plan_at(self, time: float) -> RecordedPlan | None:
        row = bisect.bisect_right(self._plan_times, time + 1e-9) - 1
        return self._plans[row] if row >= 0 else None

    @property
    def explanation(self) -> str | None:
        """None: nothing ends a recorded stream but its end."""
        return None

    def observe(self) -> Observation:
        """Return the planner's input at this tick, as it was, unless the goal was moved since."""
        tick = self._ticks[self._index]
        position, velocity, quaternion, goal = np.split(tick.values[:13], (3, 6, 10))
        state = VehicleState(position, velocity, quaternion, time=tick.time)
        sweeps = self._cloud(tick.first, tuple(map(tuple, tick.arrivals.tolist())))
        return Observation(
            tick.time,
            state,
            Goal(goal if self._goal is None else self._goal),
            sweeps,
            cloud_age=float(tick.values[13]),
            sweep_times=tick.arrivals[:, 0],
        )

    def _join(self, first: int, arrivals: tuple[tuple[float, ...], ...]) -> Sweeps:
        sweeps = [self._sweep(first + i) for i in range(len(arrivals))]
        return Sweeps(sweeps, arrivals=[Arrival(time, (x, y, z)) for time, x, y, z in arrivals])

    def _read_sweep(self, number: int) -> NDArray[np.float32]:
        """Return a sweep in the world frame [m], [P, 3], without points if it is missing or damaged."""
        try:
            rows = read_point_cloud2(self._file.read(self._sweep_places[number]), "cdr").rows.reshape(-1)
            return as_constant(np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float32, copy=False))
        except Exception:  # decompressors fail in many ways; one bad sweep must not end the playback
            return as_constant(np.empty((0, 3), np.float32))

    def advance(self, plan: Plan | None = None) -> None:
        """Go to the next tick; the plan is ignored. After the last tick the outcome is "end"."""
        if self._index + 1 < len(self._ticks):
            self._index += 1
        else:
            self.outcome = "end"

    def checkpoint(self) -> tuple[int, str | None, NDArray[np.float64] | None]:
        """Return the tick, the outcome and the goal."""
        return self._index, self.outcome, self._goal

    def restore(self, checkpoint: object) -> None:
        """Continue from a checkpoint of this source."""
        self._index, self.outcome, self._goal = checkpoint  # type: ignore[misc]

    def seek(self, time: float) -> None:
        """Go to the tick at or before `time` [s], or to the first one."""
        assert self.info.times is not None
        row = int(np.searchsorted(self.info.times, time + 1e-9, side="right")) - 1
        self._index, self.outcome = max(row, 0), None

    def set_goal(self, position: ArrayLike | None) -> None:
        """Fix the goal at `position` [m], shape [3], world frame; None is the recorded one again."""
        self._goal = None if position is None else checked_goal(position)

    def close(self) -> None:
        """Close the file."""
        self._sweep.cache_clear()
        self._cloud.cache_clear()
        self._file.close()


def _setting(contents: LogContents, name: str) -> int:
    """Return a condition of the plans, 0 if it is not known."""
    try:
        return int(parse_json(contents.attachments.get(SETTINGS, b"{}"))[name])
    except (KeyError, TypeError, ValueError):
        return 0
