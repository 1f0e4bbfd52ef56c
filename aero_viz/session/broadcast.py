"""A session as the dashboard sees it, whatever it shows: what it tells, and what it can be told."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any, Literal

from aero_planner import PlannerConfig
from aero_viz.session.frame import Frame, Notice
from aero_viz.session.sinks import Publisher, Sink
from aero_viz.session.source import Source

__all__ = ["Broadcast", "Steerable"]


class Broadcast(ABC):
    """Delivers frames, notices and whether time goes on to any number of listeners, each in a thread of its own."""

    def __init__(self) -> None:
        self._frames, self._notices, self._states = Publisher(), Publisher(), Publisher()
        self._playing = False

    @property
    @abstractmethod
    def frame(self) -> Frame | None:
        """The frame to be shown."""

    @property
    def playing(self) -> bool:
        """Whether time goes on."""
        return self._playing

    def subscribe(self, callback: Callable[[Frame], None], *, every: bool = False, name: str = "frames") -> Sink:
        """Call `callback` with the newest frame, from a thread of its own; with `every`, with each frame as long as
        fewer than 256 wait. `unsubscribe` ends it."""
        sink = self._frames.subscribe(callback, capacity=256 if every else 1, name=name)
        if self.frame is not None:
            sink.put(self.frame)
        return sink

    def subscribe_notices(self, callback: Callable[[Notice], None]) -> Sink:
        """Call `callback` with each notice, from a thread of its own."""
        return self._notices.subscribe(callback, capacity=64, name="notices")

    def subscribe_playing(self, callback: Callable[[bool], None]) -> Sink:
        """Call `callback` with `playing`, now and whenever it changes, from a thread of its own."""
        sink = self._states.subscribe(callback, capacity=64, name="playing")
        sink.put(self._playing)
        return sink

    def unsubscribe(self, sink: Sink, *, patience: float = 0.0) -> None:
        """Forget a sink and close it, when it has delivered what waits or `patience` [s] is over."""
        for publisher in (self._frames, self._notices, self._states):
            publisher.unsubscribe(sink, patience=patience)

    def notify(self, text: str, *, level: Literal["info", "error"] = "info") -> None:
        """Send a notice to everyone."""
        self._notices.publish(Notice(level, text))

    def _set_playing(self, playing: bool) -> None:
        if playing != self._playing:
            self._playing = playing
            self._states.publish(playing)

    def close_sinks(self) -> None:
        """Deliver nothing more."""
        for publisher in (self._frames, self._notices, self._states):
            publisher.close()


class Steerable(Broadcast):
    """.. and takes what the page asks for, from any thread. Who can't do something says so in a notice or an error."""

    read_only = False
    """Whether goal and settings are someone else's."""

    @property
    def waiting(self) -> str:
        """What is told as long as there is no frame."""
        return "The first plan is on its way; kernels that are new to this machine take a minute."

    @property
    @abstractmethod
    def config(self) -> PlannerConfig:
        """The planner's configuration."""

    @property
    @abstractmethod
    def speed(self) -> float:
        """Shown time per wall time."""

    @property
    @abstractmethod
    def time_range(self) -> tuple[float, float]:
        """First and last time that `seek` can reach [s]."""

    @abstractmethod
    def play(self) -> None:
        """Let time go on."""

    @abstractmethod
    def pause(self) -> None:
        """Hold time."""

    @abstractmethod
    def step(self, count: int = 1) -> Future[Any]:
        """Pause and go `count` frames on, or back when negative."""

    @abstractmethod
    def seek(self, time: float) -> Future[Any]:
        """Go to the frame at or before `time` [s]."""

    @abstractmethod
    def set_speed(self, speed: float) -> None:
        """Set shown time per wall time."""

    @abstractmethod
    def set_goal(self, position: Any, *, quiet: bool = False) -> Future[Any]:
        """Move the goal [m], shape [3], world frame; with `quiet` a refusal stands in the future only."""

    @abstractmethod
    def set_source(self, source: Source) -> Future[Any]:
        """Show another source from its start."""

    @abstractmethod
    def set_samples(self, wanted: bool) -> Future[Any]:
        """Let frames carry the Stage I samples or not."""

    @abstractmethod
    def configure(self, change: PlannerConfig | Mapping[str, Any]) -> PlannerConfig:
        """Use another configuration, or the present one with some parameters changed."""

    @abstractmethod
    def undo(self) -> PlannerConfig:
        """Return to the configuration before the present one."""

    @abstractmethod
    def redo(self) -> PlannerConfig:
        """Return to the configuration that `undo` left."""
