"""The health line of the tab Tune, with what to try one click away."""

from __future__ import annotations

import time
from collections import deque

import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.advice import Advice
from aero_viz.dashboard.health import Reading, readings
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_SPAN = 3.0
"""Source time over which the health is averaged [s]."""
_MOST_FRAMES = 60
_PERIOD = 0.4
"""Time between two updates while time runs [s]: the figures of 60 frames take 10 ms."""
_BUTTONS = 7
"""Number of figures, each of which may have something to try."""


class HealthPanel(Panel):
    """Figures of the health with their ranges, the meaning of those outside, and a button for each change to try."""

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._controls = controls
        self._frames: deque[Frame] = deque(maxlen=_MOST_FRAMES)
        self._offered: list[Advice | None] = [None] * _BUTTONS
        self._due = 0.0
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self.line = gui.add_html("")
        """The figures."""
        self.buttons = [gui.add_button("Try", color="gray", visible=False) for _ in range(_BUTTONS)]
        for number, button in enumerate(self.buttons):
            self._connect(number, button)

    def _connect(self, number: int, button: viser.GuiButtonHandle) -> None:
        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            if (advice := self._offered[number]) is not None:
                self.page.attempt(lambda: self._try(advice), event.client)

    def _try(self, advice: Advice) -> None:
        self._controls.configure(self.page.with_facts({advice.path: advice.value}))

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._frames.clear()
        return []

    def update(self, frame: Frame) -> list[Change]:
        frames = self._frames
        while frames and (frames[-1].config is not frame.config or frames[-1].time >= frame.time):
            frames.pop()  # another configuration has another health, and a tick may be planned again
        frames.append(frame)
        while frames[0].time < frame.time - _SPAN:
            frames.popleft()
        now = time.monotonic()
        if self.session.playing and now < self._due:
            return []
        self._due = now + _PERIOD
        found = readings(list(frames))
        changes: list[Change] = [(self.line, "content", _text(found))]
        for number, button in enumerate(self.buttons):
            self._offered[number] = advice = found[number].advice if number < len(found) else None
            changes.append((button, "visible", advice is not None))
            if advice is not None:
                changes.append((button, "label", f"Try {advice.text(frame.config)}"))
        return changes


def _text(found: list[Reading]) -> str:
    healthy = sum(reading.is_healthy for reading in found)
    heading = markup.heading("health of the last seconds", f"{healthy} of {len(found)} healthy")
    rows = "".join(_row(reading) for reading in found)
    return markup.block(f'<div class="aero-health">{heading}{rows}</div>')


def _row(reading: Reading) -> str:
    color = palette.GOOD if reading.is_healthy else palette.WARNING
    mark = f'<span style="color:{markup.ink(color)}">{"✓" if reading.is_healthy else "!"}</span>'
    figures = f"{markup.text(reading.value)} {markup.muted(f'({reading.healthy})')}"
    line = (
        f'<div title="{markup.text(reading.meaning)}" style="display:flex;justify-content:space-between;gap:8px">'
        f"<span>{mark} {markup.text(reading.label)}</span><span>{figures}</span></div>"
    )
    return line if reading.is_healthy else line + f'<div style="font-size:11px">{markup.muted(reading.meaning)}</div>'
