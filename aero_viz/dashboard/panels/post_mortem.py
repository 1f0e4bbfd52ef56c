"""The report on a flight that has failed."""

from __future__ import annotations

from concurrent.futures import CancelledError
from contextlib import suppress

import viser

from aero_planner.config import DroneConfig
from aero_planner.mailbox import Mailbox
from aero_viz.dashboard import palette
from aero_viz.dashboard.advice import MOST, Advice, against
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.explain.picture import draw_map
from aero_viz.explain.post_mortem import FAILURES, explain_flight
from aero_viz.explain.trace import FlightTrace
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo


class PostMortemPanel(Panel):
    """Explains every simulated flight that does not arrive, on its own thread.

    It leads to the tick in question, and offers what to try.
    """

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._controls = controls
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._trace = FlightTrace()
        self._reported: Frame | None = None
        self._tick: float | None = None
        self._offered: list[Advice] = []
        self._folder = gui.add_folder("Why the flight failed", visible=False)
        with self._folder:
            self._report = gui.add_html("")
            self._advice = gui.add_html("", visible=False)
            hint = "Apply this change, and fly the same seed again from the beginning."
            self._tries = [gui.add_button("Try", color="gray", hint=hint, visible=False) for _ in range(MOST)]
            self._go = gui.add_button("Go to that tick", icon=viser.Icon.ARROW_BACK_UP, color="gray", visible=False)
            self._map = gui.add_html("")
        self._work = Mailbox(self._work_on, name="aero-viz-post-mortem", low_priority=True)
        self._sink = self.session.subscribe(self._add, every=True, name="trace")

        @self._go.on_click
        async def _(_: viser.GuiEvent) -> None:
            if self._tick is not None:
                self.session.pause()
                self._work.put(self._tick + 1e-4)

        for number, button in enumerate(self._tries):
            self._connect(number, button)

    def _connect(self, number: int, button: viser.GuiButtonHandle) -> None:
        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            if number < len(self._offered):
                advice = self._offered[number]
                self.page.attempt(lambda: self._fly_again(advice), event.client)

    def _fly_again(self, advice: Advice) -> None:
        self.session.pause()
        self._controls.configure(self.page.with_facts({advice.path: advice.value}))
        self.session.seek(self.session.time_range[0])
        self.session.play()

    def close(self) -> None:
        self.session.unsubscribe(self._sink)
        self._work.close()

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        return [(self._folder, "visible", False)]

    def _add(self, frame: Frame) -> None:
        if not frame.source.closed_loop or frame.checkpoint is None:
            return
        self._trace.write(frame)
        if frame.outcome in FAILURES and (self._reported is None or self._reported.epoch != frame.epoch):
            self._reported = frame
            trace = FlightTrace()
            trace.frames.extend(self._trace.frames)
            self._work.put(trace)

    def _work_on(self, task: float | FlightTrace) -> None:
        """Go to a time [s], or report on a flight that has ended."""
        if isinstance(task, FlightTrace):
            self._explain(task)
        else:
            with suppress(CancelledError):
                self.session.seek(task).exception()

    def _explain(self, trace: FlightTrace) -> None:
        report, evidence = explain_flight(trace)
        shown = self.session.frame
        if shown is None or shown.source is not trace.last.source:
            return  # another source was opened in the meantime
        lines = "".join(f"<li>{markup.text(text)}</li>" for text in report.sentences)
        cause = markup.pill(report.cause or "", palette.BAD)
        list_style = "margin:6px 0;padding-left:16px"
        self._report.content = markup.block(
            f'<div class="aero-report">{cause}<ul style="{list_style}">{lines}</ul></div>'
        )
        self._offer(report.cause or "", trace.last.config)
        self._tick = None if evidence is None else evidence.frame.time
        self._go.visible = self._tick is not None
        is_collision = report.outcome == "collision"
        self._map.content = "" if evidence is None else draw_map(evidence, trace.end_position if is_collision else None)
        self._folder.visible = True

    def _offer(self, cause: str, config: DroneConfig) -> None:
        """Offer what to try against a cause."""
        self._offered = against(cause, config)
        heading = "Apply and fly again:" if self._offered else "No parameter is known that helps against this."
        self._advice.content, self._advice.visible = markup.block(markup.muted(heading)), True
        for number, button in enumerate(self._tries):
            button.visible = number < len(self._offered)
            if button.visible:
                button.label = self._offered[number].text(config)
