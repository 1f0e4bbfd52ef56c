"""What a session tells, whatever it shows: frames, notices, and whether time goes on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from aero_viz.frame import Frame, Notice
from aero_viz.sinks import Publisher, Sink

__all__ = ["Broadcast"]


class Broadcast:
    """Delivers to any number of listeners, each in a thread of its own."""

    def __init__(self) -> None:
        self._frames, self._notices, self._states = Publisher(), Publisher(), Publisher()
        self._playing = False

    @property
    def frame(self) -> Frame | None:
        """The frame to be shown."""
        raise NotImplementedError

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

    def unsubscribe(self, sink: Sink) -> None:
        """Close a sink and forget it."""
        for publisher in (self._frames, self._notices, self._states):
            publisher.unsubscribe(sink)

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
