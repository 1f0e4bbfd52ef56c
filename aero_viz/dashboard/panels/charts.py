"""Curves of the flight over source time, as one drawing with a cursor at the current tick."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.cost_text import cost_text
from aero_viz.dashboard import palette
from aero_viz.dashboard.history import COLUMNS, Event, Past, is_clearance_true
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.palette import css
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.logs.flight_figures import CLEARANCE_MAX, LABELS, FlightFigures
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame

_WIDTH, _HEIGHT = 300, 46
"""Size of one curve in the drawing [pixels]."""
_PERIOD = 0.4
"""Shortest time between two drawings while the session plays, since a long flight takes long to draw [s]."""
_GAP = 0.25
"""Time without ticks from which a line is interrupted [s]; ten ticks if that is longer."""
_GHOST_LINE = 'class="aero-ghost" stroke-dasharray="5 3"'
_NAMES = {
    "A": (("A", "B"), "the flight of configuration A"),
    "before": (("before", "now"), "the future that was left"),
}
"""Headings and description of a ghost by its name."""
_EVENT_COLORS = palette.OUTCOMES | {
    "braking": palette.WARNING,
    "parameters": palette.BRAND,
    "goal": palette.GOAL,
}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """One curve: columns of the history that share an axis."""

    label: str
    columns: tuple[str, ...]
    colors: tuple[palette.Rgb, ...]
    digits: int | None
    """Digits after the point; None for costs."""
    top: float | None = None
    """Upper end of the axis; None takes the largest value."""
    names: tuple[str, ...] = ()
    """Names of the columns, if there are several."""
    is_log: bool = False
    has_outliers: bool = False
    """The axis leaves out the largest values, so that they do not flatten the others."""

    def text(self, value: float) -> str:
        """Return a value as text."""
        return cost_text(value) if self.digits is None else f"{value:.{self.digits}f}"


CURVES = (
    Curve("speed [m/s]", ("speed",), (palette.NOSE,), 2),
    Curve("clearance [m]", ("clearance",), (palette.CHOSEN,), 2, top=CLEARANCE_MAX),
    Curve(
        "chosen S2 (log)", ("cost", "goal_cost", "collision_cost"),
        (palette.DRONE, palette.GUIDE, palette.BAD), None, names=("all", "goal", "collision"), is_log=True,
    ),
    Curve("plan [ms]", ("plan_ms",), (palette.GUIDE,), 1, has_outliers=True),  # the first plan compiles kernels
    Curve(
        "candidates", ("safe", "clear"), (palette.GOOD, palette.GUIDE), 0, names=("safe", "with clearance"),
    ),
    Curve("effective samples", ("samples",), (palette.RECORDED,), 1),
)  # fmt: skip


_COST_COLUMNS = ("cost", "goal_cost", "collision_cost", "third_cost", "fourth_cost")
"""Columns of the cost and its terms, in the order of `Plan.costs`."""


class ChartPanel(Panel):
    """Curves of every tick, the events of the flight, and the future that was left where the flight forked."""

    def create(self, gui: viser.GuiApi) -> None:
        self._due = 0.0
        self._shown: tuple[Frame, int, int] | None = None
        self.drawing = gui.add_html("")
        """The drawing."""
        labels = [curve.label for curve in CURVES]
        self._picked = gui.add_dropdown("Save", ("all curves", *labels), hint="Curves to save, with a row per tick.")
        save = gui.add_button("Download CSV", icon=viser.Icon.DOWNLOAD, color="gray", hint="Save the curves as CSV.")

        @save.on_click
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                curves = [curve for curve in CURVES if self._picked.value in ("all curves", curve.label)]
                frame = self.session.frame
                named = curves if frame is None else [_named(curve, frame) for curve in curves]
                content = table(self.page.history.past().rows, named)
                event.client.send_file_download("flight.csv", content.encode(), save_immediately=True)

    def update(self, frame: Frame) -> list[Change]:
        now = time.monotonic()
        if self.session.playing and now < self._due:
            return []
        self._due = now + _PERIOD
        past = self.page.history.past()
        shown = frame, len(past.rows), len(past.ghost)
        if not len(past.rows) or shown == self._shown:
            return []
        self._shown = shown
        return [(self.drawing, "content", markup.block(_drawing(past, frame), _fork(past)))]


def table(rows: Array, curves: Sequence[Curve]) -> str:
    """Return rows of a history as CSV: the time and the columns of some curves. Unknown values are empty cells."""
    columns = ["time", *dict.fromkeys(column for curve in curves for column in curve.columns)]
    terms = [(curve.columns[1:], curve.names[1:]) for curve in curves if curve.columns[0] == "cost"]
    heads = {column: f"{name}_cost" for pair in terms for column, name in zip(*pair, strict=True)}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([heads.get(column, column) for column in columns])
    values = rows[:, [COLUMNS.index(name) for name in columns]]
    writer.writerows([["" if np.isnan(value) else f"{value:.9g}" for value in row] for row in values])
    return text.getvalue()


def envelope(times: Array, values: Array, span: tuple[float, float], *, gap: float) -> list[Array]:
    """Return lines (x, value), each of shape [m, 2], through all values, at most four points per column of pixels.

    Each column keeps its first, smallest, largest and last value, so that no dip is lost. Lines end where the time
    between two values is longer than `gap`.

    Args:
        times: increasing [s], shape [n].
        values: shape [n].
        span: times at the left and right edge [s].
        gap: longest time to draw a line across [s].
    """
    if not len(times):
        return []
    place = (times - span[0]) / max(span[1] - span[0], 1e-9) * _WIDTH
    is_gap = np.diff(times) > gap
    firsts = np.flatnonzero(np.append(True, is_gap | (np.diff(np.floor(place)) != 0.0)))
    sizes = np.diff(firsts, append=len(times))
    kept = [firsts, firsts + sizes - 1]
    for extreme in (np.fmin, np.fmax):
        rows = np.flatnonzero(values == np.repeat(extreme.reduceat(values, firsts), sizes))
        columns = np.searchsorted(firsts, rows, side="right")
        kept.append(rows[np.unique(columns, return_index=True)[1]])
    rows = np.unique(np.concatenate(kept))
    breaks = np.searchsorted(rows, np.flatnonzero(is_gap) + 1)
    return np.split(np.stack((place[rows], values[rows]), axis=1), breaks)


def _drawing(past: Past, frame: Frame) -> str:
    """Return all curves over one axis of time as SVG."""
    ends = [past.rows[-1, 0], frame.time, *past.ghost[-1:, 0]]
    span = (float(min(past.rows[0, 0], frame.time)), float(max(ends)))
    gap = max(_GAP, 10.0 * frame.source.period)
    at = int(np.clip(np.searchsorted(past.rows[:, 0], frame.time + 1e-9) - 1, 0, len(past.rows) - 1))
    cursor = (frame.time - span[0]) / max(span[1] - span[0], 1e-9) * _WIDTH
    curves = [curve for curve in (_known(_named(curve, frame), past.rows) for curve in CURVES) if curve.columns]
    parts = [_curve(curve, past, span, gap, at) for curve in curves]
    height = len(curves) * (_HEIGHT + 18)
    marks = "".join(_mark(event, span) for event in past.events)
    difference = ""
    if past.differs_at is not None:
        x = (past.differs_at - span[0]) / max(span[1] - span[0], 1e-9) * _WIDTH
        difference = (
            f'<line class="aero-differs" x1="{x:.1f}" x2="{x:.1f}" y1="0" y2="{height}" stroke="{css(palette.GHOST)}" '
            f'stroke-width="1.5" stroke-dasharray="4 3" vector-effect="non-scaling-stroke"/>'
        )
    return (
        f'<svg viewBox="0 0 {_WIDTH} 12" preserveAspectRatio="none" style="width:100%;height:12px">{marks}</svg>'
        f'<div style="position:relative">{"".join(parts)}'
        f'<svg class="aero-marks" viewBox="0 0 {_WIDTH} {height}" preserveAspectRatio="none" '
        f'style="position:absolute;inset:0;width:100%;height:100%;pointer-events:none">'
        f'<line class="aero-cursor" x1="{cursor:.1f}" x2="{cursor:.1f}" y1="0" y2="{height}" '
        f'stroke="currentColor" stroke-width="1" vector-effect="non-scaling-stroke"/>{difference}</svg></div>'
        f'<div style="display:flex;justify-content:space-between;font-size:11px"><span>{span[0]:.2f} s</span>'
        f"<span>{span[1]:.2f} s</span></div>"
        f"{_list(past.events)}"
    )


def _known(curve: Curve, rows: Array) -> Curve:
    """Return a curve without the columns of which nothing is known."""
    is_known = [bool(np.isfinite(rows[:, COLUMNS.index(name)]).any()) for name in curve.columns]
    kept = [list(itertools.compress(values, is_known)) for values in (curve.columns, curve.colors, curve.names)]
    return dataclasses.replace(curve, columns=tuple(kept[0]), colors=tuple(kept[1]), names=tuple(kept[2]))


def _named(curve: Curve, frame: Frame) -> Curve:
    """Return a curve with the label that suits the source and the planner.

    Only a flight in a world knows the true clearance, and the terms of the cost are those of the planner.
    """
    if curve.columns[0] == "cost" and ensemble(frame.plan) is None:
        names = ("all", *frame.plan.costs)[: len(_COST_COLUMNS)]
        columns, colors = _COST_COLUMNS[: len(names)], (*curve.colors, palette.NOSE, palette.RECORDED)[: len(names)]
        return dataclasses.replace(curve, label="chosen cost (log)", columns=columns, colors=colors, names=names)
    if curve.columns != ("clearance",):
        return curve
    label = "true clearance [m]" if is_clearance_true(frame) else "clearance to the cloud [m]"
    return dataclasses.replace(curve, label=label)


def _curve(curve: Curve, past: Past, span: tuple[float, float], gap: float, at: int) -> str:
    indices = [COLUMNS.index(name) for name in curve.columns]
    largest = curve.top or _largest(curve, np.vstack((past.rows[:, indices], past.ghost[:, indices])))
    top = largest if largest > 0.0 else 1.0  # all values are zero, and lie on the lower end of any axis
    height = max(float(_scaled(curve, np.array(top))), 1e-9)

    def paths(rows: Array, opacity: float, ghost: str = "") -> str:
        drawn = ""
        for index, color in zip(indices, curve.colors, strict=True):
            known = rows[np.isfinite(rows[:, index])]
            for line in envelope(known[:, 0], known[:, index].clip(0.0, top), span, gap=gap):
                line[:, 1] = _HEIGHT - 1 - (_HEIGHT - 3) * _scaled(curve, line[:, 1]) / height
                points = " ".join([f"{x:.1f},{y:.1f}" for x, y in line.tolist()])
                drawn += (
                    f'<polyline {ghost} points="{points}" fill="none" stroke="{css(color, opacity)}" '
                    f'stroke-width="1.4" stroke-linejoin="round" vector-effect="non-scaling-stroke"/>'
                )
        return drawn

    values = [curve.text(past.rows[at, index]) for index in indices]
    is_beyond = curve.top is not None and past.rows[at, indices[0]] >= curve.top
    ghost = _ghost_value(curve, past, indices, float(past.rows[at, 0]))
    value = "" if curve.names else f"{'≥ ' if is_beyond else ''}{values[0]}"
    named = zip(curve.names, values, curve.colors, strict=False)  # without names, the value stands next to the label
    words = markup.colored([(f"{name} {number}", color) for name, number, color in named])
    heading = markup.one_line(curve.label, f"{value}{ghost}".strip()) + words
    return (
        f'<div class="aero-heading" style="font-size:11px">{heading}</div>'
        f'<svg class="aero-curve" data-curve="{curve.columns[0]}" viewBox="0 0 {_WIDTH} {_HEIGHT}" '
        f'preserveAspectRatio="none" style="display:block;width:100%;height:{_HEIGHT}px;'
        f'background:{css(palette.MUTED, 0.10)}">{paths(past.ghost, 0.4, _GHOST_LINE)}{paths(past.rows, 1.0)}'
        f'<text x="2" y="9" font-size="8" fill="{css(palette.MUTED)}">{top:.4g}</text></svg>'
    )


def _largest(curve: Curve, values: Array) -> float:
    """Return the upper end of the axis of a curve with these values, some of which may be NaN."""
    values = np.sort(values[np.isfinite(values)])
    usual = values[int(0.95 * (len(values) - 1))] * 1.25 if curve.has_outliers else np.inf
    return float(min(values[-1], usual))


def _ghost_value(curve: Curve, past: Past, indices: list[int], time: float) -> str:
    """Return the first value of the ghost at a time [s], after a space; empty where it has none."""
    at = int(np.searchsorted(past.ghost[:, 0], time + 1e-9)) - 1
    if at < 0 or past.ghost[-1, 0] < time - _GAP:
        return ""
    name = "before" if past.ghost_name == "before" else "A"
    return f" ({name} {curve.text(past.ghost[at, indices[0]])})"


def _scaled(curve: Curve, values: Array) -> Array:
    return np.log1p(values) if curve.is_log else values


def _mark(event: Event, span: tuple[float, float]) -> str:
    x = (event.time - span[0]) / max(span[1] - span[0], 1e-9) * _WIDTH
    color = css(_EVENT_COLORS.get(event.kind, palette.WARNING))
    return f'<rect class="aero-event" x="{x - 1.5:.1f}" y="0" width="3" height="12" fill="{color}"/>'


def _list(events: Sequence[Event], most: int = 6) -> str:
    """Return the last events, one per line."""
    lines = [
        f'<div style="font-size:11px"><span style="color:{markup.ink(_EVENT_COLORS.get(event.kind, palette.WARNING))}">'
        f"{event.time:.2f} s</span> {markup.text(event.text)}</div>"
        for event in events[-most:]
    ]
    more = f'<div style="font-size:11px">{markup.muted(f"{len(events) - most} earlier events")}</div>'
    return (more if len(events) > most else "") + "".join(lines)


def _fork(past: Past) -> str:
    """Return the figures of the flight and its ghost, side by side."""
    if not len(past.ghost):
        return ""
    names, what = _NAMES.get(past.ghost_name, (("A", "B"), f"A, {past.ghost_name}"))
    same = "They do not differ so far." if past.differs_at is None else f"They first differ at {past.differs_at:.2f} s."
    solid = (
        "The flight was continued from an earlier tick" if past.ghost_name == "before" else "Two flights are compared"
    )
    note = markup.note(f"{solid}: the dashed curves are {what}. {same}")
    return f'<div class="aero-fork">{note}{flight_table(past, names)}</div>'


def flight_table(past: Past, names: tuple[str, str], *, ghost_state: str = "not over") -> str:
    """Return the figures of the ghost and of the flight as HTML, both from the start of the flight on.

    Args:
        past: the flight and its ghost, which must not be empty.
        names: heading of the ghost and of the flight.
        ghost_state: outcome of a ghost that has none.
    """
    whole = np.vstack((past.common, past.ghost))
    ghost = FlightFigures.from_columns(dict(zip(COLUMNS, whole.T, strict=True)), past.ghost_outcome or ghost_state)
    flight = FlightFigures.from_columns(dict(zip(COLUMNS, past.rows.T, strict=True)), past.outcome or "flying")
    rows = [tuple(row) for row in zip(LABELS, ghost.texts(), flight.texts(), strict=True)]
    return markup.columns(("flight", *names), rows)
