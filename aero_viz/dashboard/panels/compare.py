"""Comparison of two configurations on the same tick and on the same flight."""

from __future__ import annotations

import asyncio

import numpy as np
import viser

from aero_planner import PlannerConfig, PlanStatus
from aero_planner.config import DroneConfig
from aero_viz.dashboard.history import Past
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.charts import flight_table
from aero_viz.dashboard.panels.status import clearance_text
from aero_viz.planners.plan import ensemble
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.safety import known_safe

_PIN_HINT = (
    "Pin the present configuration as A; the controls below change B. While the session is paused, both plan its tick, "
    "and the rollouts of A have the colour of the ghost."
)
_FLY_HINT = "A flies from this tick to its end, as the ghost; then B flies from the same tick, with the same noise."


class ComparePanel(Panel):
    """Pins configuration A, and shows how its plan and its flight differ from those of B."""

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._controls = controls
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._pin = gui.add_button("Compare: pin as A", icon=viser.Icon.PIN, color="gray", hint=_PIN_HINT)
        self._fly = gui.add_button(
            "Fly A and B from here", icon=viser.Icon.DRONE, color="gray", hint=_FLY_HINT, visible=False
        )
        self._swap = gui.add_button(
            "Swap A and B", icon=viser.Icon.ARROWS_EXCHANGE, color="gray", visible=False,
            hint="Pin B, and load A into the controls.",
        )  # fmt: skip
        self._stop = gui.add_button(
            "Stop comparing", icon=viser.Icon.PINNED_OFF, color="gray", visible=False, hint="Unpin A."
        )
        self.table = gui.add_html("")
        """The comparison in figures."""

        @self._pin.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(self._controls.pin, event.client)

        @self._fly.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(self._controls.fly_both, event.client)

        @self._swap.on_click
        async def _(event: viser.GuiEvent) -> None:
            # Pinning waits for the session, and the event loop serves all pages.
            await asyncio.to_thread(self.page.attempt, self._exchange, event.client)

        @self._stop.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(self._controls.unpin, event.client)

    def _exchange(self) -> None:
        a = self._controls.comparison.pinned
        if a is not None:
            self._controls.pin().result()
            self._controls.configure(a)

    def update_without_frame(self) -> list[Change]:
        is_pinned = self._controls.comparison.pinned is not None
        shown = [(button, "visible", is_pinned) for button in (self._fly, self._swap, self._stop)]
        return [(self._pin, "visible", not is_pinned), *shown]

    def update(self, frame: Frame) -> list[Change]:
        past = self.page.history.past()
        content = ""
        if past.pinned is not None:
            content = markup.block(*self._tables(frame, past, past.pinned))
        return [*self.update_without_frame(), (self.table, "content", content)]

    def _tables(self, frame: Frame, past: Past, pinned: DroneConfig) -> list[str]:
        a = past.alternative_to(frame)
        parts = [parameter_table(pinned, self.session.config)]
        if a is not None:
            parts.append(tick_table(a, frame))
        else:
            parts.append(markup.muted("A plans while the session is paused."))
        if len(past.ghost) and past.ghost_name == "A":
            is_flying = self._controls.comparison.is_flying
            progress = f"flying: {past.ghost[-1, 0]:.1f} s" if is_flying else "cut short"
            parts.append(flight_table(past, ("A", "B"), ghost_state=progress))
            if past.differs_at is not None:
                what = "A and B differ" if frame.source.closed_loop else "A and B choose different instances"
                parts.append(markup.muted(f"{what} from {past.differs_at:.2f} s on."))
        return parts


def parameter_table(a: DroneConfig, b: DroneConfig) -> str:
    """Return the parameters in which A and B differ as HTML."""
    differences = a.differences(b)
    if not differences:
        return markup.muted("A and B are the same configuration: move a slider below to change B.")
    rows = [(a.find(path).title, f"{old}", f"{new}") for path, (old, new) in differences.items()]
    return markup.columns(("parameter", "A", "B"), rows, tooltips=list(differences))


def tick_table(a: Frame, b: Frame) -> str:
    """Return the plans of A and B for the same tick in figures, as HTML."""
    figures = [_plan(frame) for frame in (a, b)]
    labels = dict.fromkeys(label for plan in figures for label in plan)
    rows = [(label, *(plan.get(label, "") for plan in figures)) for label in labels]
    return markup.columns((f"plan at {b.time:.2f} s", "A", "B"), rows)


def _plan(frame: Frame) -> dict[str, str]:
    """Return the figures of a plan by their labels. Terms that only one planner has are empty for the other one."""
    plan, best, config = frame.plan, int(frame.plan.best), frame.config
    full = ensemble(plan)
    terms = {name: float(cost[best]) for name, cost in plan.costs.items()}
    figures = {"chosen instance": f"{best} {plan.kinds[best]}", "S2" if full else "cost": f"{plan.cost[best]:.5g}"}
    figures |= {f"{name} cost": f"{value:.5g}" for name, value in terms.items()}
    if full is not None:
        figures["speed limit and blocked path"] = f"{float(plan.cost[best]) - sum(terms.values()):.5g}"
    figures["clearance of the plan [m]"] = clearance_text(frame).replace("≥", "≥ ")
    figures["speed at its end [m/s]"] = f"{np.linalg.norm(plan.velocities[best, -1]):.2f}"
    figures["safe candidates"] = _safe_count(frame)
    if isinstance(config, PlannerConfig):
        clear = np.count_nonzero(plan.clearance.min(axis=1) >= config.candidates.safe_clearance)
        figures["candidates with clearance"] = f"{clear} of {len(plan.kinds)}"
    return figures | {"plan time [ms]": f"{frame.timings_ms.get('plan', 0.0):.1f}"}


def _safe_count(frame: Frame) -> str:
    """Return how many candidates are safe, which asks for a clear stop besides the clearance."""
    if frame.plan.status == PlanStatus.STALE_CLOUD:
        return "no cloud"
    limit = "at most " if frame.is_safe is None else ""
    return f"{limit}{np.count_nonzero(known_safe(frame))} of {len(frame.plan.kinds)}"
