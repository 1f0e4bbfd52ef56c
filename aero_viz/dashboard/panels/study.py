"""A study of `aero-viz tune` on the page: its progress, its Pareto front, and the importance of each parameter."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Sequence

import viser

from aero_planner.config import DroneConfig, PlannerConfig
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.palette import css
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.errors import UserError
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame
from aero_viz.study_view import Importance, Study, StudyPoint, StudyView

_PERIOD = 1.0
"""Time between two polls of the study [s]."""
_BUTTONS = 12
"""Largest number of points of the front that can be clicked."""
_WIDTH, _HEIGHT = 300, 190
"""Size of the front [pixels]."""
_CLICK = "[...document.querySelectorAll('button')].find(b => b.textContent.startsWith('{}'))?.click()"
"""Script of a point of the front, which clicks its button."""


class StudyPanel(Panel):
    """Follows a study. A click on a point of its front makes its configuration B and the present one A."""

    def __init__(self, page: Page, controls: SessionControls, study: Study) -> None:
        self._controls, self._study = controls, study
        self._view = study.read()
        self._error = ""
        self._shown: tuple[object, ...] = ()
        self._candidates: list[StudyPoint] = []
        """Points of the buttons, as they are shown."""
        self._ended = threading.Event()
        super().__init__(page)
        self._thread = threading.Thread(target=self._follow, name="aero-viz-study", daemon=True)
        self._thread.start()

    def create(self, gui: viser.GuiApi) -> None:
        axes = list(self._view.axes)
        self._state = gui.add_html("")
        self._bar = gui.add_progress_bar(0.0, color="blue")
        self._x_axis = gui.add_dropdown("x axis", axes, initial_value=axes[1])
        self._y_axis = gui.add_dropdown("y axis", axes, initial_value=axes[2] if len(axes) > 2 else axes[0])
        self.front = gui.add_html("")
        """The Pareto front."""
        hint = "Use this candidate as B, and compare it with the present configuration, A."
        self._buttons = [gui.add_button("", color="gray", hint=hint, visible=False) for _ in range(_BUTTONS)]
        self.importance = gui.add_html("")
        """The importance of each parameter."""
        for index, button in enumerate(self._buttons):

            @button.on_click
            async def _(event: viser.GuiEvent, index: int = index) -> None:
                # The session plans with B, and the event loop serves all pages.
                await asyncio.to_thread(self.page.attempt, lambda: self._compare(index), event.client)

        for choice in (self._x_axis, self._y_axis):

            @choice.on_update
            async def _(_: viser.GuiEvent) -> None:
                self.page.refresh()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()

    def update_without_frame(self) -> list[Change]:
        view, axes = self._view, (self._x_axis.value, self._y_axis.value)
        shown = view, axes, self.session.config, self._error
        if shown == self._shown:
            return []
        self._shown = shown
        self._candidates = front = _clickable(view, axes[0])
        chosen = next((point.trial for point in front if self._config(point) == self.session.config), None)
        changes: list[Change] = [
            (self._state, "content", markup.block(_state(view), self._error and markup.muted(self._error))),
            (self._bar, "value", 100.0 * view.progress),
            (self._bar, "animated", view.finished < view.asked and not self._error),
            (self.front, "content", markup.block(_front(view, axes, chosen), _legend(view))),
            (self.importance, "content", markup.block(_importance(view))),
        ]
        for index, button in enumerate(self._buttons):
            if index < len(front):
                label = f"{_label(front[index])} {_figures(front[index], axes)}"
                color = "blue" if front[index].trial == chosen else "gray"
                changes += [(button, "label", label), (button, "color", color)]
            changes.append((button, "visible", index < len(front)))
        return changes

    def update(self, frame: Frame) -> list[Change]:
        return self.update_without_frame()

    def _follow(self) -> None:
        """Poll the study while a visitor is on the page."""
        while not self._ended.wait(_PERIOD):
            if not self.page.server.get_clients():
                continue
            before = self._view, self._error
            try:
                self._view, self._error = self._study.read(), ""
            except UserError as error:
                self._error = str(error)
            if (self._view, self._error) != before:
                self.page.refresh()

    def _compare(self, index: int) -> None:
        if index < len(self._candidates):
            self._controls.compare_with(self._config(self._candidates[index])).result()

    def _config(self, point: StudyPoint) -> DroneConfig:
        """Return the configuration of a candidate, with the facts of the present flight."""
        return self.page.config_for_flight(point.config)


def _clickable(view: StudyView, axis: str) -> list[StudyPoint]:
    """Return the points of the front by their figure on an axis, without the incumbent."""
    front = [point for point in view.points if point.on_front and point.trial is not None]
    return sorted(front, key=lambda point: point.estimates[axis].value)[:_BUTTONS]


def _label(point: StudyPoint) -> str:
    return f"Trial {point.trial}:"


def _figures(point: StudyPoint, axes: Sequence[str]) -> str:
    return ", ".join(f"{point.estimates[axis].value:.3g} {_unit(axis)}" for axis in dict.fromkeys(axes))


def _unit(axis: str) -> str:
    return axis.partition("[")[2].rstrip("]")


def progress(view: StudyView) -> str:
    """Return how far a study is, in words. The incumbent flies before the first candidate."""
    if not view.flights:
        return f"no flight has ended yet, {view.asked} candidates to fly"
    return f"{view.finished} of {view.asked} candidates, {view.flights} flights"


def _state(view: StudyView) -> str:
    return f'<div class="aero-study">{markup.heading(view.name, progress(view))}</div>'


def _legend(view: StudyView) -> str:
    if not view.points:
        return markup.muted("The results appear here once the incumbent or a candidate has flown in all worlds.")
    return markup.muted(
        f"Green: candidates that no other one beats, at most {_BUTTONS}; click one to make it B. Grey: the others that "
        "flew in all worlds. Square: the incumbent. Lines: 95 % intervals."
    )


def _importance(view: StudyView) -> str:
    if not view.importance:
        return markup.muted("The importance of parameters needs 8 candidates that flew in all worlds.")
    find = view.points[0].config.find if view.points else PlannerConfig.find
    rows = "".join(_share(one, find(one.path).title) for one in view.importance)
    return markup.muted("Importance for being among the best quarter (PED-ANOVA, 90 % bootstrap interval)") + rows


def _share(one: Importance, title: str) -> str:
    low, width = 100.0 * one.low, 100.0 * max(one.high - one.low, 0.005)
    figure = f"{100.0 * one.share:.0f} % ({100.0 * one.low:.0f} to {100.0 * one.high:.0f})"
    return (
        f'<div class="aero-importance" title="{markup.text(one.path)}">'
        f"{markup.heading(title, figure)}"
        f'<div style="position:relative;height:6px;background:{css(palette.MUTED, 0.15)}">'
        f'<div style="height:6px;width:{100.0 * one.share:.1f}%;background:{css(palette.BRAND)}"></div>'
        f'<div style="position:absolute;top:2px;height:2px;left:{low:.1f}%;width:{width:.1f}%;'
        f'background:{css(palette.DRONE)}"></div></div></div>'
    )


def _front(view: StudyView, axes: tuple[str, str], chosen: int | None) -> str:
    """Return the candidates over two axes as SVG."""
    points = [point for point in view.points if all(axis in point.estimates for axis in axes)]
    if not points:
        return ""
    spans = [_span([point.estimates[axis].value for point in points]) for axis in axes]
    front = {point.trial for point in _clickable(view, axes[0])}
    points.sort(key=lambda point: point.trial in front)  # on top
    marks = "".join(_mark(point, axes, spans, point.trial in front, point.trial == chosen) for point in points)
    (left, right), (low, high) = spans
    return (
        f'<div style="font-size:11px">{markup.heading(axes[1], f"{low:.3g} to {high:.3g}")}</div>'
        f'<svg class="aero-front" viewBox="0 0 {_WIDTH} {_HEIGHT}" style="width:100%;display:block;'
        f'background:{css(palette.MUTED, 0.08)}">{marks}</svg>'
        f'<div style="font-size:11px">{markup.heading(axes[0], f"{left:.3g} to {right:.3g}")}</div>'
    )


def _span(values: Sequence[float]) -> tuple[float, float]:
    margin = 0.06 * (max(values) - min(values)) or 0.5
    return min(values) - margin, max(values) + margin


def _mark(
    point: StudyPoint, axes: tuple[str, str], spans: Sequence[tuple[float, float]], is_front: bool, is_chosen: bool
) -> str:
    (left, right), (low, high) = spans
    across, up = (point.estimates[axis] for axis in axes)

    def x(value: float) -> float:
        return min(max((value - left) / (right - left), 0.0), 1.0) * _WIDTH

    def y(value: float) -> float:
        return _HEIGHT - min(max((value - low) / (high - low), 0.0), 1.0) * _HEIGHT

    place = x(across.value), y(up.value)
    name = "incumbent" if point.trial is None else f"trial {point.trial}"
    intervals = ", ".join(f"{axis} {estimate}" for axis, estimate in point.estimates.items())
    tooltip = f"<title>{markup.text(f'{name}: {intervals}')}</title>"
    if point.trial is None:
        corner = f'x="{place[0] - 4:.1f}" y="{place[1] - 4:.1f}" width="8" height="8"'
        return f'<rect {corner} fill="none" stroke="{css(palette.WARNING)}" stroke-width="2">{tooltip}</rect>'
    centre = f'cx="{place[0]:.1f}" cy="{place[1]:.1f}"'
    if not is_front:
        return f'<circle {centre} r="3" fill="{css(palette.MUTED, 0.6)}">{tooltip}</circle>'
    color, script = css(palette.GOOD), markup.text(_CLICK.format(_label(point)))
    lines = (
        f'<path d="M{x(across.low):.1f} {place[1]:.1f}H{x(across.high):.1f}M{place[0]:.1f} {y(up.low):.1f}'
        f'V{y(up.high):.1f}" stroke="{css(palette.GOOD, 0.35)}" style="pointer-events:none"/>'
    )
    ring = f' stroke="{css(palette.DRONE)}" stroke-width="2"' if is_chosen else ""
    return (
        f'{lines}<circle class="aero-candidate" data-trial="{point.trial}" {centre} r="6" fill="{color}"{ring} '
        f'style="cursor:pointer" onclick="{script}">{tooltip}</circle>'
    )
