"""Configurations A and B through the worlds of ten seeds, while the page goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable

import viser

from aero_planner.config import DroneConfig
from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.source import SourcePanel
from aero_viz.flight.known_drone import config_for_next_flight
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.paired_seeds import fly_seeds
from aero_viz.session.source import Source
from aero_viz.statistics import PairedSeeds, SeedFlight

COUNT = 10
"""Number of seeds."""
_HINT = (
    f"Fly A and B from the start through the worlds of {COUNT} seeds, the open one first, in the background. Obstacles "
    "that were changed by hand are not in them."
)
_VERDICTS = {"noise": "That may be chance.", "A": "A is better.", "B": "B is better."}


class SeedsPanel(Panel):
    """Flies the pinned configuration and the present one through the worlds of ten seeds, on its own thread.

    Args:
        page: page of the panel.
        controls: commands of the session.
        sources: opens the present flight with another seed.
    """

    def __init__(self, page: Page, controls: SessionControls, sources: SourcePanel) -> None:
        self._controls, self._sources = controls, sources
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._stopped = threading.Event()
        self._stopped.set()
        self._fly = gui.add_button(
            f"Fly {COUNT} seeds", icon=viser.Icon.DICE_5, color="gray", visible=False, hint=_HINT
        )
        self._stop = gui.add_button("Stop flying seeds", icon=viser.Icon.X, color="gray", visible=False)
        self.table = gui.add_html("")
        """The flights so far."""
        self._work = Mailbox(self._run, name="aero-viz-seeds", low_priority=True)

        @self._fly.on_click
        async def _(_: viser.GuiEvent) -> None:
            a, frame = self._controls.comparison.pinned, self.session.frame
            if a is not None and frame is not None and self._stopped.is_set():
                self._stopped.clear()
                self._work.put((a, self.session.config, frame))
                self.page.refresh()

        @self._stop.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._stopped.set()

    def close(self) -> None:
        self._stopped.set()
        self._work.close()

    def update(self, frame: Frame) -> list[Change]:
        is_flying = not self._stopped.is_set()
        can_fly = self._controls.comparison.pinned is not None and frame.source.closed_loop
        return [(self._fly, "visible", can_fly and not is_flying), (self._stop, "visible", is_flying)]

    def _run(self, task: tuple[DroneConfig, DroneConfig, Frame]) -> None:
        """Fly, on the mailbox's thread."""
        (a, b, frame), opened = task, self._sources.opening
        seeds = range(opened.seed, opened.seed + COUNT)

        def known(config: DroneConfig) -> Callable[[Source], DroneConfig]:
            return lambda source: config_for_next_flight(config, before=frame.source, after=source.info)

        def fly() -> None:
            flights = fly_seeds(
                self._sources.reopen, seeds, known(a), known(b), device=frame.device, goes_on=self._goes_on
            )
            self._show(markup.note(f"0 of {COUNT} seeds .."))
            for flown in flights:
                self._show(_table(flown))

        self.page.attempt(fly)
        self._stopped.set()
        self.page.refresh()

    def _goes_on(self) -> bool:
        return not self._stopped.is_set()

    def _show(self, content: str) -> None:
        if self._goes_on():
            self.table.content = content


def _table(flown: PairedSeeds) -> str:
    """Return the flights of A and B, and whether they differ, as HTML."""
    paired, count = flown.comparison, len(flown.seeds)
    rows = [(f"seed {seed}", _end(a), _end(b)) for seed, a, b in zip(flown.seeds, flown.a, flown.b, strict=True)]
    arrived = (f"{paired.arrived_a} of {count}", f"{paired.arrived_b} of {count}")
    ranges = [f"{low:.0%} to {high:.0%}" for low, high in flown.intervals]
    rows += [("arrived", *arrived), ("95 % interval", ranges[0], ranges[1])]
    test = f"Only A arrives on {paired.only_a} seeds, only B on {paired.only_b}: p = {paired.p_arrival:.2g}."
    if paired.slower_by_s is not None:
        mean, low, high = paired.slower_by_s
        test += f" Where both do, B takes {mean:+.2f} s ({low:+.2f} to {high:+.2f}), p = {paired.p_time:.2g}."
    verdict = _VERDICTS[paired.verdict]
    title = f"{count} of {COUNT} seeds"
    table = markup.columns((title, "A", "B"), rows)
    return markup.block(f'<div class="aero-seeds">{table}</div>', markup.muted(f"{test} {verdict}"))


def _end(flight: SeedFlight) -> str:
    return f"{flight.flight_time_s:.2f} s" if flight.arrived else flight.outcome.replace("_", " ")
