"""Writes a flight to a file, in the format that the suffix of its name selects."""

from __future__ import annotations

import contextlib
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from aero_planner.config import DroneConfig
from aero_planner.output_files import check_output_files, whole_file
from aero_viz.dashboard.page_view import PageView
from aero_viz.dashboard.share.page import page
from aero_viz.dashboard.share.scene_recording import SceneRecording
from aero_viz.dashboard.signals import drone_clearance
from aero_viz.errors import UserError
from aero_viz.session import Session
from aero_viz.session.frame import Frame
from aero_viz.session.source import Source

SUFFIXES = {
    ".html": "a page that plays offline",
    ".mp4": "a video",
    ".png": "a picture of the last moment, with the panels",
    ".mcap": "the log, for play, Foxglove and RViz",
}
"""Kinds of files, by the end of their name."""
FRAME_PERIOD = 0.04
"""Shortest time between two pictures of a flight [s]."""
T = TypeVar("T")
Report = Callable[[float], None]


def share(
    source: Source,
    path: str | Path,
    *,
    command: str,
    config: DroneConfig | None = None,
    seed: int = 0,
    device: str = "cpu",
    duration: float = 60.0,
    layers: Sequence[str] | None = None,
    report: Report = lambda _: None,
) -> None:
    """Fly or replay `source` and write it to a file.

    Args:
        source: source to show; closed afterwards.
        path: file to write, with one of `SUFFIXES`. An existing one is replaced once the new one is complete.
        command: command that shows the flight live, for the page.
        config: configuration of the planner; None is the default.
        seed: seed of the planner's noise.
        device: Warp device of the planner.
        duration: longest time to show [s].
        layers: names of the layers to show; None shows those that are on by default.
        report: called with the source's time [s] after each tick.

    Raises:
        UserError: the duration is not positive, the name has no known suffix, a layer is unknown, or a program for
            pictures is missing.
        ValueError: the file cannot be written.
    """
    try:
        if not duration > 0.0:
            raise UserError(f"The duration is {duration:g} s; it must be positive.")
        check_path(Path(path))
    except (UserError, ValueError):
        source.close()
        raise
    session = Session(source, config=config, device=device, seed=seed)
    try:
        frames = flight_frames(session, duration, report)
        if Path(path).suffix.lower() == ".png":
            _write_picture(session, frames, Path(path), layers)
        else:
            write(frames, Path(path), command=command, layers=layers, report=report)
    finally:
        session.close()


def check_path(path: Path, *, overwrite: bool = True) -> None:
    """Check that a file of a known kind can be written there; see `check_output_files`.

    Raises:
        UserError: the suffix is unknown.
        ValueError: the file cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        kinds = ", ".join(f"{suffix} ({kind})" for suffix, kind in SUFFIXES.items())
        raise UserError(f"The name {path} does not say what to write; end it in one of {kinds}.")
    check_output_files(path, overwrite=overwrite)


class FlightFiles:
    """Writes what the page shows to files; implements `aero_viz.dashboard.panels.share.Files`."""

    def write(self, frames: Iterable[Frame], path: Path, **options: Any) -> None:
        """Write frames as a page, a video or a log, see `write`."""
        write(frames, path, **options)

    def picture(self, url: str, view: PageView) -> bytes:
        """Return a picture of the page at an address as PNG."""
        from aero_viz.dashboard.share.pictures import page_picture

        return _in_thread(lambda: page_picture(url, view))


def write(
    frames: Iterable[Frame],
    path: Path,
    *,
    command: str,
    layers: Sequence[str] | None = None,
    report: Report = lambda _: None,
) -> None:
    """Write frames of one source, in chronological order, as a page, a video or a log."""
    suffix = path.suffix.lower()
    with _complete(path) as partial:
        if suffix == ".mcap":
            _write_log(frames, partial)
            return
        with tempfile.TemporaryDirectory() as folder:
            page = partial if suffix == ".html" else Path(folder) / "flight.html"
            duration = _write_page(frames, page, command=command, layers=layers)
            if suffix == ".mp4":
                from aero_viz.dashboard.share.pictures import write_video

                _in_thread(lambda: write_video(page, partial, duration=duration, report=report))


def _write_picture(session: Session, frames: Iterable[Frame], path: Path, layers: Sequence[str] | None) -> None:
    """Write a picture of the page, with its panels, at the last of the frames."""
    from aero_viz.dashboard import Dashboard
    from aero_viz.dashboard.share.pictures import page_picture

    with _complete(path) as partial:
        for _ in frames:
            pass
        dashboard = Dashboard(session, port=0)
        try:
            dashboard.show_only(layers)
            partial.write_bytes(_in_thread(lambda: page_picture(dashboard.url, PageView())))
        finally:
            dashboard.close()


@contextlib.contextmanager
def _complete(path: Path) -> Iterator[Path]:
    """Yield a file to write, which replaces `path` at the end unless something fails."""
    try:
        with whole_file(path, alone=True) as partial:
            yield partial
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}.") from error


def _in_thread(action: Callable[[], T]) -> T:
    """Return the result of `action`, run on a thread without an event loop, as Playwright requires.

    Python ends without waiting for this thread, whose browser may wait for a page that is no longer served.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(action())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, name="aero-viz-pictures", daemon=True).start()
    return future.result()


def flight_frames(session: Session, duration: float, report: Report = lambda _: None) -> Iterator[Frame]:
    """Yield the ticks of a session from now on, up to its end or for `duration` [s]."""
    frame = session.tick()
    start = frame.time
    while True:
        report(frame.time)
        yield frame
        if frame.outcome is not None or frame.time - start >= duration - 1e-6:
            return
        frame = session.tick()


def thinned(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield the frames that are at least `FRAME_PERIOD` apart, and the last one."""
    due, held = -np.inf, None
    for frame in frames:
        held = frame
        if frame.time >= due - 1e-6:
            due, held = frame.time + FRAME_PERIOD, None
            yield frame
    if held is not None:
        yield held


def ending(frame: Frame) -> str:
    """Return one sentence on how a flight ended."""
    if frame.explanation:
        return frame.explanation
    return {"arrived": f"Arrived after {frame.time:.1f} s.", None: ""}.get(frame.outcome, str(frame.outcome))


def _write_page(frames: Iterable[Frame], path: Path, *, command: str, layers: Sequence[str] | None) -> float:
    """Write a page and return the duration of the flight [s]."""
    recording = SceneRecording(layers)
    try:
        figures, frame = [], None
        for frame in thinned(frames):
            recording.add(frame)
            speed = float(np.linalg.norm(np.asarray(frame.observation.actual_state.velocity)))
            figures.append((frame.time, speed, drone_clearance(frame)))
        assert frame is not None
        content = page(
            recording.as_html(),
            np.array(figures),
            name=frame.source.name,
            ending=ending(frame),
            command=command,
            legend=recording.legend,
        )
        path.write_text(content, encoding="utf-8")
        return recording.duration
    finally:
        recording.close()


def _write_log(frames: Iterable[Frame], path: Path) -> None:
    from aero_viz.logs import FlightLog

    log = FlightLog(path)
    try:
        for frame in frames:
            log.write(frame)
    finally:
        log.close()
