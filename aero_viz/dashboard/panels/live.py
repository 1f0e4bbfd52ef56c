"""The tab of a live stream: its topics, what is assumed about them, what is wrong, and the recording."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from pathlib import Path

import viser

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import TYPING_DELAY, Page, Panel
from aero_viz.errors import UserError
from aero_viz.live.health import TopicHealth
from aero_viz.live.session import StreamSession
from aero_viz.session.frame import Frame


@dataclass(frozen=True)
class LiveOffer:
    """What the tab offers."""

    folder: Path
    """Folder to which recordings are written."""


class LivePanel(Panel):
    """Topics with their rates and clocks, assumptions, findings, and a button that records."""

    def __init__(self, page: Page, session: StreamSession, offer: LiveOffer) -> None:
        self._stream_session, self._offer = session, offer
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self.text = gui.add_html("")
        """The topics and what is known of them."""
        self._name = gui.add_text("File", "live.mcap", hint="MCAP file to record, in the folder of the program.")
        self.record_button = gui.add_button(
            "Record",
            icon=viser.Icon.PLAYER_RECORD,
            color="red",
            hint="Write what arrives and what is planned, also while the picture is held. Play it with: aero-viz play",
        )
        self.stop_button = gui.add_button("Stop recording", icon=viser.Icon.PLAYER_STOP, color="gray", visible=False)

        @self.record_button.on_click
        async def _(event: viser.GuiEvent) -> None:
            await asyncio.sleep(TYPING_DELAY)
            self.page.attempt(self._record, event.client)

        @self.stop_button.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(lambda: self._stream_session.stop_recording().result(), event.client)

    def _record(self) -> None:
        name = self._name.value.strip()
        if not name or Path(name).name != name or name.startswith("."):
            raise UserError(f"{name!r} is not the name of a file; recordings are written to {self._offer.folder}.")
        path = (self._offer.folder / name).with_suffix(".mcap")
        if path.exists():
            raise UserError(f"{path.name} exists already; give another name.")
        self._stream_session.record(path).result()

    def update(self, frame: Frame) -> list[Change]:
        recorder = self._stream_session.recorder
        return [
            (self.text, "content", self._content(frame)),
            (self.record_button, "visible", recorder is None),
            (self.stop_button, "visible", recorder is not None),
            (self._name, "disabled", recorder is not None),
        ]

    def _content(self, frame: Frame) -> str:
        source = self._stream_session.stream_source
        now, setup = source.stream.clock.now(), source.setup
        shown = [health for name, health in source.stream.topics.items() if name in (*setup.used, source.goal_topic)]
        rows = "".join(
            _row(health, is_missed=health.topic in setup.used and health.is_silent(now))
            for health in shown
            if health.count or health.topic in setup.used
        )
        behind = (now - source.newest.arrival) * 1e-9
        recorder = self._stream_session.recorder
        writing = "" if recorder is None else markup.pill(f"recording {recorder.ticks} ticks", palette.WARNING)
        findings = "".join(_line(f"{f.evidence}. Next: {f.advice}.") for f in setup.findings if f.is_fault)
        return markup.block(
            writing,
            markup.heading("topics", f"newest tick {1e3 * behind:.0f} ms ago") + rows,
            findings and markup.heading("findings") + findings,
            markup.heading("assumed") + "".join(f"<div>{markup.text(text)}</div>" for text in setup.assumptions),
        )


def _row(health: TopicHealth, *, is_missed: bool) -> str:
    """Return a topic as HTML; a goal that was sent once is silent, and not missed."""
    rate = f"{1.0 / health.period:.0f} Hz" if health.period else f"{health.count} messages"
    color, state = (palette.WARNING, "silent") if is_missed else (palette.GOOD, rate)
    offset = "" if health.offset is None else f", {1e3 * health.offset:.0f} ms old" if abs(health.offset) < 1.0 else ""
    left_out = f", {sum(health.unused.values())} left out" if health.unused else ""
    missing = f", {health.missing} missing" if health.missing else ""
    return (
        f'<div style="display:flex;justify-content:space-between;gap:8px"><span>{markup.text(health.topic)}</span>'
        f'<span style="color:{markup.ink(color)}">{markup.text(state + offset + left_out + missing)}</span></div>'
    )


def _line(sentence: str) -> str:
    return f'<div style="color:{markup.ink(palette.WARNING)}">{markup.text(sentence)}</div>'
