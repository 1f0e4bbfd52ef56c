"""Comparison of two configurations on the same tick and on the same flight."""

from __future__ import annotations

import asyncio

import numpy as np
import viser

from aero_planner import PlannerConfig, PlanStatus
from aero_planner.config import DroneConfig
from aero_planner.mailbox import Mailbox
from aero_viz.cost_text import cost_text
from aero_viz.dashboard.folders import Folders
from aero_viz.dashboard.history import Past
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import TYPING_DELAY, Page, Panel
from aero_viz.dashboard.panels.flight_table import flight_table
from aero_viz.dashboard.panels.status import clearance_text
from aero_viz.errors import UserError
from aero_viz.explain.crossed_costs import ChoiceCost, CrossedCosts, crossed_costs
from aero_viz.explain.evidence import Replanner
from aero_viz.reader_process import ReaderProcess
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.session.safety import known_safe

_PIN_HINT = (
    "Pin the present configuration as A; the controls below change B. While the session is paused, both plan its tick, "
    "and the rollouts of A have the colour of the ghost."
)
_LOG_HINT = "Path of a flight log, whose flight becomes the ghost and the dashed curves."
_FLY_HINT = "A flies from this tick to its end, as the ghost; then B flies from the same tick, with the same noise."


class ComparePanel(Panel):
    """Pins configuration A, and shows how its plan and its flight differ from those of B; or lays a log beside.

    Args:
        page: page of the panel.
        controls: controls of the session.
        folders: folders whose logs may be laid beside the flight.
    """

    def __init__(self, page: Page, controls: SessionControls, folders: Folders) -> None:
        self._controls, self._folders = controls, folders
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
        with gui.add_folder("A log beside", expand_by_default=False):
            self._log = gui.add_text("Log", "", hint=_LOG_HINT)
            show = gui.add_button("Show log", icon=viser.Icon.CHART_LINE, color="gray", hint=_LOG_HINT)
            self._hide = gui.add_button("Hide log", icon=viser.Icon.CHART_LINE, color="gray", visible=False)
        self._replan = Replanner()
        self._wanted: tuple[Frame, Frame] | None = None
        self._costs: CrossedCosts | None = None
        self._work = Mailbox(self._weigh, name="aero-viz-compare", low_priority=True)
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

        @show.on_click
        async def _(event: viser.GuiEvent) -> None:
            await asyncio.sleep(TYPING_DELAY)
            await asyncio.to_thread(self.page.attempt, self._lay_beside, event.client)

        @self._hide.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(lambda: self.page.history.lay_beside(None), event.client)

    def _lay_beside(self) -> None:
        """Read the log that was named, in another process, and show it as the ghost."""
        from aero_viz.logs.comparison import LoggedFlight

        if self._controls.comparison.pinned is not None:
            raise UserError("Configuration A is the ghost: stop comparing before you lay a log beside the flight.")
        path = self._folders.find(self._log.value.strip())
        reader = ReaderProcess(folders=self._folders.paths)
        self.page.history.lay_beside(reader(LoggedFlight.read, str(path)))

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
        is_beside = len(past.ghost) > 0 and past.ghost_name not in ("A", "before")
        content = ""
        if past.pinned is not None:
            content = markup.block(*self._tables(frame, past, past.pinned))
        return [*self.update_without_frame(), (self._hide, "visible", is_beside), (self.table, "content", content)]

    def close(self) -> None:
        self._work.close()
        self._replan.close()

    def _costs_of(self, a: Frame, b: Frame) -> CrossedCosts | None:
        """Return the costs of both choices by the weights of each, once they are known."""
        key = a, b
        if key != self._wanted:
            self._wanted = key
            self._work.put(key)
        costs = self._costs
        return costs if costs is not None and (costs.a, costs.b) == key else None

    def _weigh(self, frames: tuple[Frame, Frame]) -> None:
        """Plan again with both configurations, on the mailbox's thread, and show the costs."""
        self._costs = crossed_costs(self._replan, *frames)
        self.page.refresh()

    def _tables(self, frame: Frame, past: Past, pinned: DroneConfig) -> list[str]:
        a = past.alternative_to(frame)
        parts = [parameter_table(pinned, self.session.config)]
        if a is not None:
            parts.append(tick_table(a, frame, self._costs_of(a, frame)))
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


def tick_table(a: Frame, b: Frame, costs: CrossedCosts | None = None) -> str:
    """Return the plans of A and B for the same tick in figures, as HTML.

    Args:
        a: frame of A.
        b: frame of B.
        costs: costs of both choices by the weights of each; None shows those by their own weights.
    """
    figures = [_plan(frame, with_costs=costs is None) for frame in (a, b)]
    labels = dict.fromkeys(label for plan in figures for label in plan)
    rows = [(label, *(plan.get(label, "") for plan in figures)) for label in labels]
    if costs is not None:
        for name, choices in (("A", costs.by_a), ("B", costs.by_b)):
            rows += _cost_rows(name, choices)
    return markup.columns((f"plan at {b.time:.2f} s", "A", "B"), rows)


def _cost_rows(name: str, choices: tuple[ChoiceCost, ChoiceCost]) -> list[tuple[str, str, str]]:
    """Return what the choices of A and B cost by the weights of one of them."""
    a, b = choices
    rows = (
        (f"S2 by the weights of {name}", a.s2, b.s2), ("goal", a.goal, b.goal), ("collision", a.collision, b.collision),
        ("other terms", a.rest, b.rest),
    )  # fmt: skip
    return [(label if i == 0 else f"· {label}", cost_text(x), cost_text(y)) for i, (label, x, y) in enumerate(rows)]


def _plan(frame: Frame, *, with_costs: bool) -> dict[str, str]:
    """Return the figures of a plan by their labels, on request with its costs by its own weights."""
    plan, best, config = frame.plan, int(frame.plan.best), frame.config
    figures = {"chosen instance": f"{best} {plan.kinds[best]}"}
    if with_costs:
        figures["cost by its own weights"] = cost_text(float(plan.cost[best]))
        figures |= {f"· {name}": cost_text(float(cost[best])) for name, cost in plan.costs.items()}
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
