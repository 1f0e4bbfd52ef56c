"""Which parameters change the plan of the tick at which time stands still."""

from __future__ import annotations

import time

import viser

from aero_planner import PlannerConfig
from aero_planner.mailbox import Mailbox
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.errors import UserError
from aero_viz.explain.evidence import Replanner
from aero_viz.explain.sensitivity import SHARE, Effect, Sensitivity, sensitivity
from aero_viz.session.frame import Frame

_LINES = 10
_PERIOD = 0.3
"""Time between two reports of the progress [s]."""
_HINT = (
    f"Plan this tick again with each live parameter {SHARE:.0%} lower and higher, and list those that change the "
    "choice or its clearance."
)
_OTHER = "Sensitivity needs AERO-MPPI: other planners do not tell on what a plan of theirs builds."


class SensitivityPanel(Panel):
    """Plans the present tick again with other values of each parameter, on its own thread, while time stands still."""

    def create(self, gui: viser.GuiApi) -> None:
        self._replan = Replanner()
        self._is_running = self._is_closed = False
        hint = {"icon": viser.Icon.ADJUSTMENTS_ALT, "color": "gray", "hint": _HINT}
        self._button = gui.add_button("Sensitivity of this tick", visible=False, **hint)
        self._missing = gui.add_html(markup.note(_OTHER), visible=False)
        self.table = gui.add_html("")
        """The strongest effects."""
        self._work = Mailbox(self._run, name="aero-viz-sensitivity", low_priority=True)

        @self._button.on_click
        async def _(_: viser.GuiEvent) -> None:
            frame = self.session.frame
            if frame is not None and not self._is_running:
                self._is_running = True
                self._work.put(frame)
                self.page.refresh()

    def close(self) -> None:
        self._is_closed = True
        self._work.close()
        self._replan.close()

    def update(self, frame: Frame) -> list[Change]:
        is_known = isinstance(frame.config, PlannerConfig)
        can_run = is_known and frame.checkpoint is not None and not self.session.playing
        return [
            (self._button, "visible", can_run or self._is_running),
            (self._button, "disabled", self._is_running),
            (self._missing, "visible", not is_known),
        ]

    def _run(self, frame: Frame) -> None:
        """Plan again and again, on the mailbox's thread."""
        due = 0.0

        def follow(done: int, total: int) -> bool:
            nonlocal due
            if (now := time.monotonic()) >= due:
                due = now + _PERIOD
                self.table.content = markup.note(f"{done} of {total} plans ..")
            return not self._is_closed and not self.session.playing

        try:
            found = sensitivity(self._replan, frame, progress=follow)
            if not self._is_closed:
                self.table.content = markup.note("Stopped: time runs.") if found is None else _table(frame, found)
        except UserError as error:
            self.table.content = markup.note(str(error))
        finally:
            self._is_running = False
            self.page.refresh()


def _table(frame: Frame, found: list[Sensitivity]) -> str:
    """Return the strongest effects on the plan of a frame as HTML."""
    visible = [one for one in found if one.is_visible]
    rows = [(one.info.title, _text(one.less), _text(one.more)) for one in visible[:_LINES]]
    header = (f"plan at {frame.time:.2f} s", f"−{SHARE:.0%}", f"+{SHARE:.0%}")
    table = markup.columns(header, rows, [one.info.path for one in visible])
    legend = f"{len(visible)} of {len(found)} parameters matter: the choice where it is another one, and the change of "
    legend += "its clearance [m]."
    return markup.block(f'<div class="aero-sensitivity">{table}</div>', markup.muted(legend))


def _text(effect: Effect | None) -> str:
    if effect is None or not effect.is_visible:
        return "·"
    return f"{effect.choice + ' ' if effect.is_other else ''}{effect.clearance:+.2f}"
