"""Interfaces between sessions and the programs that show or control them, such as the dashboard."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Literal, Protocol

from numpy.typing import ArrayLike

from aero_planner.config import DroneConfig
from aero_planner.mailbox import Mailbox
from aero_viz.session.drone_tuning import DroneTuning
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.publisher import Publisher
from aero_viz.session.source import Source
from aero_viz.session.timeline import Checkpoint

if TYPE_CHECKING:
    from aero_viz.session.comparison import Comparison


class SessionControls(Protocol):
    """Commands that change a session: its source, its goal, its speed and its configuration. Safe from any thread."""

    device: str
    """Warp device of the planner."""

    @property
    def seed(self) -> int:
        """Seed of the planner's noise."""
        ...

    def set_source(
        self,
        source: Source,
        *,
        seed: int | None = None,
        convert: Callable[[DroneConfig], DroneConfig] | None = None,
    ) -> Future[Any]:
        """Continue with another source, from its start, and with another seed of the planner's noise.

        `convert` replaces every configuration before the first tick, which cannot be undone.
        """
        ...

    def set_goal(self, position: ArrayLike, *, quiet: bool = False) -> Future[Any]:
        """Move the goal [m], shape [3], world frame. With `quiet`, a refusal is reported in the future only."""
        ...

    def alter(self, change: Callable[[Any], object], *, quiet: bool = False, step: object = None) -> Future[Any]:
        """Call `change` with the source between two ticks, and plan the current tick again."""
        ...

    def set_speed(self, speed: float) -> None:
        """Set the source time that passes per wall time."""
        ...

    def set_samples(self, enabled: bool) -> Future[Any]:
        """Include the Stage I samples in frames, or leave them out."""
        ...

    def judge_candidates(self) -> Future[Any]:
        """Say in every frame from now on which candidates are safe."""
        ...

    def configure(self, change: DroneConfig | Mapping[str, Any]) -> DroneConfig:
        """Use another configuration, or change some parameters of the current one."""
        ...

    def flown(self) -> Future[list[tuple[Checkpoint, DroneConfig]]]:
        """Return every tick of the source so far, with the configuration of its last plan."""
        ...

    def undo(self) -> DroneConfig:
        """Take back the newest change of the configuration or of the world, and return the configuration."""
        ...

    def redo(self) -> DroneConfig:
        """Redo the change that was undone last, and return the configuration."""
        ...

    @property
    def comparison(self) -> Comparison:
        """State of the comparison with a pinned configuration, A."""
        ...

    def pin(self) -> Future[Any]:
        """Pause, and make the present configuration A, with which every later configuration, B, is compared."""
        ...

    def unpin(self) -> Future[Any]:
        """End the comparison."""
        ...

    def compare_with(self, config: DroneConfig) -> Future[Any]:
        """Use `config` as B against the pinned configuration, A; without one, the present one is pinned first."""
        ...

    def fly_both(self) -> Future[Any]:
        """Pause, let A fly from the present tick to its end, and then play B from there."""
        ...


def completed() -> Future[Any]:
    """Return a future that is done."""
    future: Future[Any] = Future()
    future.set_result(None)
    return future


class BaseSession(ABC):
    """Publishes frames, notices and the playback state to any number of listeners, and moves through recorded time.

    Each listener has its own thread, so that a slow one delays nobody else.
    """

    def __init__(self, *, playing: bool = False) -> None:
        self._frames = Publisher[Frame]()
        self._notices = Publisher[Notice]()
        self._playing_changes = Publisher[bool]()
        self._playing = playing

    @property
    @abstractmethod
    def controls(self) -> SessionControls | None:
        """Commands that change the session; None for a session that can only be watched."""

    @property
    def tuning(self) -> DroneTuning | None:
        """Changes of the parameters of a drone in flight; None for any other session."""
        return None

    @property
    @abstractmethod
    def frame(self) -> Frame | None:
        """The frame to show; None before the first plan."""

    @property
    @abstractmethod
    def config(self) -> DroneConfig:
        """The planner's configuration."""

    @property
    @abstractmethod
    def time_range(self) -> tuple[float, float]:
        """First and last time that `seek` can reach [s]."""

    @property
    def playing(self) -> bool:
        """True while time advances."""
        return self._playing

    @property
    def speed(self) -> float:
        """Source time that passes per wall time."""
        return 1.0

    @property
    def is_stream(self) -> bool:
        """True if time goes on by itself, so that playback means to follow it."""
        return False

    @property
    def waiting_message(self) -> str:
        """Text for the user as long as there is no frame."""
        return "The first plan is being computed. Kernels that are new to this machine take a minute to compile."

    @abstractmethod
    def play(self) -> None:
        """Resume playback."""

    @abstractmethod
    def pause(self) -> None:
        """Stop time at the current frame."""

    @abstractmethod
    def step(self, count: int = 1) -> Future[Any]:
        """Pause and move by `count` frames, backward if negative."""

    @abstractmethod
    def seek(self, time: float) -> Future[Any]:
        """Go to the frame at or before `time` [s]."""

    def catch_up(self) -> Future[Any]:
        """Return a future that completes once all earlier commands have run."""
        return completed()

    def subscribe(
        self, callback: Callable[[Frame], None], *, every: bool = False, name: str = "frames"
    ) -> Mailbox[Frame]:
        """Call `callback` with the current frame and those that follow, on a separate thread, until `unsubscribe`.

        A callback that is too slow gets the newest frame only. With `every`, up to 256 frames wait for it instead.
        """
        sink = self._frames.subscribe(callback, capacity=256 if every else 1, name=name)
        if self.frame is not None:
            sink.put(self.frame)
        return sink

    @contextlib.contextmanager
    def every_frame(self, callback: Callable[[Frame], None], *, name: str, timeout: float = 2.0) -> Iterator[None]:
        """Call `callback` with every frame, as `subscribe` does, while the context is open.

        At its end, frames that still wait are delivered for up to `timeout` [s], and no call goes on.
        """
        sink = self.subscribe(callback, every=True, name=name)
        try:
            yield
        finally:
            self.unsubscribe(sink, timeout=timeout)
            sink.close(timeout=None)

    def subscribe_notices(self, callback: Callable[[Notice], None]) -> Mailbox[Notice]:
        """Call `callback` with each notice, on a separate thread, until `unsubscribe`."""
        return self._notices.subscribe(callback, capacity=64, name="notices")

    def subscribe_playing(self, callback: Callable[[bool], None]) -> Mailbox[bool]:
        """Call `callback` with `playing`, now and at every change, on a separate thread, until `unsubscribe`."""
        sink = self._playing_changes.subscribe(callback, capacity=64, name="playing")
        sink.put(self._playing)
        return sink

    def unsubscribe(self, sink: Mailbox[Any], *, timeout: float = 0.0) -> None:
        """Remove and close a sink. Items that still wait are delivered for up to `timeout` [s]."""
        for publisher in (self._frames, self._notices, self._playing_changes):
            publisher.unsubscribe(sink, timeout=timeout)

    def notify(self, text: str, *, level: Literal["info", "failure", "error"] = "info") -> None:
        """Publish a notice."""
        self._notices.publish(Notice(level, text))

    def close_sinks(self) -> None:
        """Close all sinks. Items that still wait are dropped."""
        for publisher in (self._frames, self._notices, self._playing_changes):
            publisher.close()

    def _set_playing(self, playing: bool) -> None:
        if playing != self._playing:
            self._playing = playing
            self._playing_changes.publish(playing)
