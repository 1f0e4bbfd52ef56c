"""Play, pause, step, speed and the timeline."""

from __future__ import annotations

import threading
import time

import viser

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame
from aero_viz.session.sinks import Sink
from aero_viz.session.source import Source

__all__ = ["PlaybackPanel"]

_SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, "1": 1.0, "2": 2.0, "4": 4.0}
_HOLD = 0.7
"""How long the timeline is left to the hand that moved it [s]."""


class PlaybackPanel(Panel):
    """Controls of the session's clock."""

    def create(self, gui: viser.GuiApi) -> None:
        self._touched = -_HOLD
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE, color="gray")
        self._restart = gui.add_button(
            "Restart", icon=viser.Icon.PLAYER_SKIP_BACK, color="gray", hint="Go back to the beginning.",
            visible=not self.session.read_only,
        )  # fmt: skip
        self._steps = gui.add_button_group(
            "Step", ("-10", "-1", "+1", "+10"), hint="Pause and go some ticks back or on."
        )
        self._time = gui.add_slider(
            "Time", 0.0, 1.0, 0.01, 0.0,
            hint="Pause and go to this time [s]. A flight can be flown differently from there on.",
        )  # fmt: skip
        self._speed = gui.add_dropdown("Speed", tuple(_SPEEDS), initial_value="1", hint="Source time per wall time.")
        # Of the positions that a drag passes through, only the newest is worth going to.
        self._seeks = Sink(self._seek, name="seek")
        self._connect(gui)

    def _connect(self, gui: viser.GuiApi) -> None:
        session = self.session

        @self._play.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._toggle()

        @self._restart.on_click
        async def _(_: viser.GuiEvent) -> None:
            session.seek(session.time_range[0])

        @self._steps.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._step(int(self._steps.value))

        @self._time.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._touched = time.monotonic()
                session.pause()
                self._seeks.put(float(self._time.value))

        @self._speed.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                session.set_speed(_SPEEDS[self._speed.value])

        play = gui.add_command("Play or pause", hotkey="P", icon=viser.Icon.PLAYER_PLAY)
        play.on_trigger(lambda _: self._toggle())
        on = gui.add_command("Step on", hotkey="arrowright", modifier="shift", icon=viser.Icon.PLAYER_TRACK_NEXT)
        on.on_trigger(lambda _: self._step(1))
        back = gui.add_command("Step back", hotkey="arrowleft", modifier="shift", icon=viser.Icon.PLAYER_TRACK_PREV)
        back.on_trigger(lambda _: self._step(-1))

    def close(self) -> None:
        self._seeks.close()

    def _step(self, count: int) -> None:
        self.session.step(count)

    def _seek(self, wanted: float) -> None:
        self.session.seek(wanted).exception()  # waits; what went wrong the session says
        # While time stands still no frame follows that would show where the seek led.
        settled = threading.Timer(1.1 * _HOLD, self.page.refresh)
        settled.daemon = True
        settled.start()

    def _toggle(self) -> None:
        if self.session.playing:
            self.session.pause()
        else:
            self.session.play()

    def enter(self, source: Source) -> list[Change]:
        return [(self._time, "step", max(round(source.period, 3), 0.001))]

    def wait(self) -> list[Change]:
        playing = self.session.playing
        return [
            (self._play, "label", "Pause" if playing else "Play"),
            (self._play, "icon", viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY),
            (self._play, "color", "gray" if playing else "green"),
        ]

    def update(self, frame: Frame) -> list[Change]:
        changes = self.wait()
        if time.monotonic() - self._touched > _HOLD:
            first, last = self.session.time_range
            changes += [
                (self._time, "min", round(first, 3)),
                (self._time, "max", round(max(last, first + 0.02), 3)),
                (self._time, "value", round(min(max(frame.time, first), last), 3)),
            ]
        return changes
