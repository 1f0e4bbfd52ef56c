"""The end of a flight, as it was flown: the input of a post-mortem."""

from __future__ import annotations

import contextlib
import dataclasses
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aero_planner import Sweeps, VehicleState
from aero_viz.errors import UserError
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.single import FlightRecorder, FlightRecorders
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame

KEPT = 6.0
"""Time before the end of which frames are kept [s]: longer than a stall takes; a frame is 0.1 MB."""


class FlightTrace:
    """Keeps the last frames of a flight; a recorder of `aero_viz.flight.fly`, and a sink of a session.

    Attributes:
        frames: frames of the last `KEPT` seconds, in the order of time.
        end: time [s] and true state at the end of the flight, later than the last frame; None if it is not known.
        outcome: how a recorded flight ended; None takes it from the last frame.
        explanation: what a log says of the end.
        missing: sentences on missing facts.
    """

    def __init__(self) -> None:
        self.frames: deque[Frame] = deque()
        self.end: tuple[float, VehicleState] | None = None
        self.outcome: str | None = None
        self.explanation = ""
        self.missing: list[str] = []

    def write(self, frame: Frame) -> None:
        """Take the frame of a tick; a tick that is planned again replaces it and all later ones."""
        if self.frames and self.frames[-1].source is not frame.source:
            self.frames.clear()
        while self.frames and self.frames[-1].time >= frame.time - 1e-9:
            self.frames.pop()
        self.frames.append(_small(frame))
        while self.frames[0].time < frame.time - KEPT:
            self.frames.popleft()

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Take the true state at a time [s]."""
        self.end = time, state

    @property
    def last(self) -> Frame:
        """The last frame."""
        return self.frames[-1]

    @property
    def end_time(self) -> float:
        """Time of the end [s]."""
        return self.last.time if self.end is None else max(self.end[0], self.last.time)

    @property
    def end_position(self) -> NDArray[np.float64]:
        """Last true position [m], shape [3]."""
        return np.asarray(self._end_state.position, dtype=np.float64)

    @property
    def end_velocity(self) -> NDArray[np.float64]:
        """Last true velocity [m/s], shape [3]."""
        return np.asarray(self._end_state.velocity, dtype=np.float64)

    @property
    def _end_state(self) -> VehicleState:
        is_later = self.end is not None and self.end[0] >= self.last.time
        return self.end[1] if is_later and self.end is not None else self.last.observation.actual_state

    @property
    def rules(self) -> FlightRules:
        """Rules of the flight."""
        return FlightSettings.from_dict(self.last.source.settings).rules


def _small(frame: Frame) -> Frame:
    """Return a frame without its largest parts: the samples, and the joined cloud if it was read."""
    seen = frame.observation
    whole = len(seen.sweeps) - seen.sweeps.thinned if seen.sweeps.thinned else None
    observation = dataclasses.replace(seen, sweeps=Sweeps(seen.sweeps, whole=whole, arrivals=seen.sweeps.arrivals))
    plan = ensemble(frame.plan)
    kept = frame.plan if plan is None or plan.samples is None else dataclasses.replace(plan, samples=None)
    return dataclasses.replace(frame, observation=observation, plan=kept)


@contextlib.contextmanager
def recorder(trace: FlightTrace, log: str | Path | None = None) -> Iterator[FlightRecorder]:
    """Give the context a recorder for `fly` that fills a trace and, on request, a log.

    Raises:
        UserError: the log cannot be written.
    """
    from aero_viz.logs import flight_recorder

    with contextlib.ExitStack() as stack:
        files = [] if log is None else [stack.enter_context(flight_recorder(log))]
        yield FlightRecorders(trace, *files)


def trace_of_log(path: str | Path, *, device: str = "cpu") -> FlightTrace:
    """Return the end of the flight in a log, planned again on the recorded clouds with the recorded configuration.

    Raises:
        UserError: the file is not a flight log, or cannot be read.
    """
    from aero_viz.logs.log_contents import is_flight_log, read_log
    from aero_viz.logs.replay import FlightReplay
    from aero_viz.recordings import open_recording
    from aero_viz.session import Session

    if not Path(path).is_file():
        raise UserError(f"There is no file {path}.")
    if not is_flight_log(path):
        raise UserError(f"{path} is not a flight log, which `aero-viz fly WORLD --log FILE` writes: it has no plans.")
    trace, contents = FlightTrace(), read_log(path)
    trace.missing += [contents.damage] if contents.damage else []
    config = contents.config()
    if config is None:
        trace.missing.append("The log holds no configuration: the default one was planned with.")
    recording = open_recording(str(path))
    source = FlightReplay(recording, path)
    session = Session(source, config=config, device=device)
    try:
        times = session.source.times
        assert times is not None
        session.tick()
        session.seek(max(float(times[0]), float(times[-1]) - KEPT)).result()
        while session.frame is not None and session.frame.outcome is None:
            trace.write(session.frame)
            session.tick()
    finally:
        session.close()
    poses = recording.poses
    if poses is not None:
        time = float(poses.times[-1])
        pose = poses.interpolate(time)
        trace.write_pose(time, VehicleState(pose.position, pose.velocity, pose.quaternion))
    trace.outcome, trace.explanation = contents.outcome or None, contents.explanation or ""
    if not contents.outcome:
        trace.missing.append("The log does not say how the flight ended: it was cut off, or a drone wrote it.")
    if source.info.world is None:
        trace.missing.append("The log holds no world: obstacles have no names, and what was occluded is not known.")
    trace.missing.append(
        "Decisions, statuses and clearances are those of the log. It holds no candidates: what is marked as computed "
        "again is from plans on the recorded clouds, whose noise differs from that of the flight."
    )
    return trace
