"""Explains the plan that is shown: why an instance was chosen or not, and where a point came from."""

from __future__ import annotations

import time

import numpy as np
import viser

from aero_planner.mailbox import Mailbox
from aero_viz.cost_text import cost_text
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.layers.selection import SelectionLayer
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.open_tabs import OpenTabs
from aero_viz.dashboard.panels.why_card import NUMBERED_MAX, card, chart
from aero_viz.errors import UserError
from aero_viz.explain.evidence import PlanEvidence, Replanner
from aero_viz.explain.picking import describe_point, pick
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_PERIOD = 0.7
"""Shortest time between two explanations while time runs [s]: each plans again."""
_HINT = (
    "Plan the present tick again and split its costs. Then click an anchor, a guide, a rollout, a point or a cell "
    "in the scene, or a number below."
)


class WhyPanel(Panel):
    """Costs by term over all instances, and the card of the selection. It computes nothing while it is switched off.

    The selection is highlighted in the scene, and follows clicks there, while the tab is open.

    Args:
        page: page of the panel.
        tabs: the tabs that are open.
    """

    def __init__(self, page: Page, tabs: OpenTabs) -> None:
        self._tabs = tabs
        self._instance: int | None = None
        """Selected instance."""
        self._point: np.ndarray | None = None
        """Selected point of the cloud [m], shape [3]."""
        super().__init__(page)
        tabs.on_change(self._follow_tab)

    def create(self, gui: viser.GuiApi) -> None:
        self._replan = Replanner()
        self._evidence: PlanEvidence | None = None
        self._due = 0.0
        self._shown: tuple[object, ...] = ()
        self._switch = gui.add_checkbox("Explain the plan", False, hint=_HINT)
        self._chart = gui.add_html("")
        self._numbers = gui.add_button_group("Instance", ("none",), visible=False, hint="Select an instance.")
        self._card = gui.add_html("")
        self._work = Mailbox(self._explain, name="aero-viz-why", low_priority=True)

        @self._switch.on_update
        async def _(_: viser.GuiEvent) -> None:
            scene = self.page.server.scene
            if self._switch.value:
                scene.on_click()(self._click)
            else:
                scene.remove_click_callback(self._click)
            self.select(None)

        @self._numbers.on_click
        async def _(_: viser.GuiEvent) -> None:
            self.select(None if self._numbers.value == "none" else int(self._numbers.value))

    def select(self, instance: int | None, point: np.ndarray | None = None) -> None:
        """Select an instance or a point of the cloud [m], shape [3], and highlight it everywhere."""
        self._instance, self._point = instance, point
        self._highlight()
        self._due = 0.0
        self.page.refresh()

    def _follow_tab(self) -> None:
        if self._instance is not None or self._point is not None:
            self._highlight()
            self.page.refresh()

    def _highlight(self) -> None:
        """Highlight the selection in the scene and in the chart of the rollouts if a visitor has the tab open."""
        is_open = self._tabs.is_open("Why")
        instance, point = (self._instance, self._point) if is_open else (None, None)
        if isinstance(layer := self.page.layers.get("selection"), SelectionLayer):
            layer.instance, layer.point = instance, point
        if isinstance(rollouts := self.page.layers.get("rollouts"), RolloutLayer):
            rollouts.selected = instance

    def close(self) -> None:
        self._work.close()
        self._replan.close()

    def _click(self, event: viser.SceneClickEvent) -> None:
        frame = self.session.frame
        if frame is None or not self._tabs.is_open("Why", event.client_id):
            return
        cells = any(
            self.page.layers[name].visible for name in ("fine_cells", "coarse_cells") if name in self.page.layers
        )
        picked = pick(frame, event.ray_origin, event.ray_direction, cells=cells)
        self.select(None if picked is None else picked.instance, None if picked is None else picked.point)

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        self._due = 0.0
        self._instance = self._point = None
        self._highlight()
        return []

    def update(self, frame: Frame) -> list[Change]:
        if not self._switch.value:
            self._shown = ()
            return [(self._chart, "content", ""), (self._card, "content", ""), (self._numbers, "visible", False)]
        now = time.monotonic()
        wanted = self._key(frame)
        if wanted != self._shown and (not self.session.playing or now >= self._due):
            self._due = now + _PERIOD
            self._shown = wanted
            self._work.put(frame)
        count = len(frame.plan.kinds)
        options = ("none", *map(str, range(count if count <= NUMBERED_MAX else 0)))
        changes: list[Change] = [(self._numbers, "visible", True)]
        return changes if self._numbers.options == options else [*changes, (self._numbers, "options", options)]

    def _key(self, frame: Frame) -> tuple[object, ...]:
        return frame, self._instance, None if self._point is None else tuple(self._point.tolist())

    def _explain(self, frame: Frame) -> None:
        """Explain a frame and show the result, on the mailbox's thread."""
        _, instance, point = self._key(frame)
        try:
            evidence = self._evidence
            if evidence is None or evidence.frame is not frame:
                evidence = self._evidence = self._replan(frame)
        except UserError as error:
            self._show(markup.text(error))
            return
        parts = _recorded(frame)
        if isinstance(instance, int) and instance < len(evidence.plan.kinds):
            parts.append(card(evidence, instance))
        if isinstance(point, tuple):
            facts = markup.table([(label, value, "") for label, value in describe_point(frame, np.array(point))])
            parts.append(f'<div class="aero-point">{facts}</div>')
        if not parts:
            parts.append(markup.muted("Click an anchor, a guide, a rollout, a point or a cell, or a number above."))
        self._show(chart(evidence, instance if isinstance(instance, int) else None), *parts)

    def _show(self, bars: str, *parts: str) -> None:
        if self._switch.value:  # it may have been switched off in the meantime
            self._chart.content = markup.block(bars)
            self._card.content = markup.block(*parts) if parts else ""


def _recorded(frame: Frame) -> list[str]:
    """Return the parts of the flown plan that a log holds, and those that it lacks."""
    if (plan := frame.recorded_plan) is None:
        return []
    text = (
        f"The log holds S2 and clearance of each recorded instance ({plan.best} {plan.kinds[plan.best]}: S2 "
        f"{cost_text(plan.stage2_cost[plan.best])}, {plan.clearance[plan.best]:.2f} m), but neither terms nor "
        "samples: what follows explains the live planner on the recorded cloud."
    )
    return [markup.muted(text)]
