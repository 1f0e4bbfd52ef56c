"""Play, pause, step, speed and timeline."""

from __future__ import annotations

import contextlib
import threading
from concurrent.futures import CancelledError

import numpy as np
import viser

from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Hold, Panel
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
_STEPS_MAX = 50
"""Largest number of pending ticks while the session is moving: one second of a flight."""


class PlaybackPanel(Panel):
    """Controls of the session's clock and timeline."""

    def create(self, gui: viser.GuiApi) -> None:
        self._touched = Hold()
        is_stream = self.session.is_stream
        hint = "Play or pause. Parameters change the plan while paused as well. Key: Space."
        if is_stream:
            hint = "Hold the picture, or return to the newest tick. The stream goes on meanwhile. Key: Space."
        # Two buttons of which one is visible: a click on one whose label changes would do the opposite of what the page
        # showed if the flight was paused, or ended, while the click was on its way.
        self.play_button = gui.add_button(
            "Now" if is_stream else "Play",
            icon=viser.Icon.PLAYER_PLAY,
            color="green",
            hint=hint,
            visible=not self.session.playing,
        )
        self.pause_button = gui.add_button(
            "Pause", icon=viser.Icon.PLAYER_PAUSE, color="gray", hint=hint, visible=self.session.playing
        )
        if self.session.controls is not None and not is_stream:
            self._add_restart(gui)
        self._steps = gui.add_button_group(
            "Step", ("-10", "-1", "+1", "+10"), hint="Pause and move by this many ticks."
        )
        self._time = gui.add_slider(
            "Time [s]", 0.0, 1.0, 0.01, 0.0,
            hint="Pause and go to this time [s]. A flight can continue differently from there.",
        )  # fmt: skip
        if self.session.controls is not None and not is_stream:
            self._add_speed(gui, self.session.controls)
        self._waiting: tuple[float | None, int] = (None, 0)
        """The pending move: a time to go to [s] or None, and a number of ticks from there."""
        self._lock = threading.Lock()
        self._moves = Mailbox(self._move, name="aero-viz-moves")
        self._connect(gui)

    def _add_restart(self, gui: viser.GuiApi) -> None:
        restart = gui.add_button(
            "Restart",
            icon=viser.Icon.PLAYER_SKIP_BACK,
            color="gray",
            hint="Go back to the beginning. A flight that has ended is flown again.",
        )

        @restart.on_click
        async def _(_: viser.GuiEvent) -> None:
            frame = self.session.frame
            if frame is not None and frame.outcome is not None:
                self.session.play()  # from the beginning
            else:
                self._seek(self.session.time_range[0])

    def _add_speed(self, gui: viser.GuiApi, controls: SessionControls) -> None:
        hint = "Source time per wall-clock time."
        speed = gui.add_dropdown("Playback speed", tuple(_SPEEDS), initial_value="1", hint=hint)

        @speed.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                controls.set_speed(_SPEEDS[speed.value])

    def _connect(self, gui: viser.GuiApi) -> None:
        @self.play_button.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.session.play()

        @self.pause_button.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.session.pause()

        @self._steps.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.step(int(self._steps.value))

        @self._time.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._touched.begin()
                self.seek(float(self._time.value))

    def close(self) -> None:
        self._moves.close()

    def _seek(self, time: float) -> None:
        """Go to the tick nearest to a time [s]; while the session is moving, only the newest request is kept."""
        with self._lock:
            self._waiting = (time, 0)
        self._moves.put(None)

    def seek(self, time: float) -> None:
        """Pause, and go to the tick nearest to a time [s]."""
        self.session.pause()
        self._seek(time)

    def step(self, count: int) -> None:
        """Move by a number of ticks; while the session is moving, clicks add up to at most `_STEPS_MAX`."""
        with self._lock:
            time, steps = self._waiting
            self._waiting = (time, min(max(steps + count, -_STEPS_MAX), _STEPS_MAX))
        self._moves.put(None)

    def _move(self, _: None) -> None:
        """Make the pending move, on the mailbox's thread. The session reports errors itself."""
        with self._lock:
            (time, steps), self._waiting = self._waiting, (None, 0)
        with contextlib.suppress(CancelledError):
            if time is not None:
                self.session.seek(self._time_of_nearest_tick(time)).exception()
                self.page.refresh_after()
            if steps:
                self.session.step(steps).exception()

    def _time_of_nearest_tick(self, time: float) -> float:
        """Return a time [s] from which `seek`, which goes to the tick at or before it, reaches the nearest tick."""
        frame = self.session.frame
        if frame is None:
            return time
        times = frame.source.times
        return time + 0.499 * frame.source.period if times is None else float(times[np.abs(times - time).argmin()])

    def toggle(self) -> None:
        """Play or pause."""
        if self.session.playing:
            self.session.pause()
        else:
            self.session.play()

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        return [(self._time, "step", max(round(source.period, 3), 0.001))]

    def update_without_frame(self) -> list[Change]:
        playing = self.session.playing
        return [(self.play_button, "visible", not playing), (self.pause_button, "visible", playing)]

    def update(self, frame: Frame) -> list[Change]:
        changes = self.update_without_frame()
        if not self._touched:
            first, last = self.session.time_range
            changes += [
                (self._time, "min", round(first, 3)),
                (self._time, "max", round(max(last, first + 0.02), 3)),
                (self._time, "value", round(min(max(frame.time, first), last), 3)),
            ]
        return changes
