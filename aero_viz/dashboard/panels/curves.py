"""The dock below the scene: curves of the flight over its time, for each visitor those that he or she has chosen."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import curve_lanes, palette
from aero_viz.dashboard.curve_lanes import Lane
from aero_viz.dashboard.curve_script import SCRIPT, STYLE
from aero_viz.dashboard.history import Event, Past
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.page_messages import CurvesMessage, CurvesSaveMessage, SeekMessage
from aero_viz.dashboard.palette import css
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.flight_table import fork_table
from aero_viz.dashboard.signals import Signal, is_clearance_true
from aero_viz.dashboard.viser_private import identifier, run_script, show
from aero_viz.session.frame import Frame

_PERIOD = 0.4
"""Shortest time between two updates of the curves while the session plays [s]."""
_PIXELS = 2
"""Width of a bucket of ticks in the picture [pixels]."""
_GAP = 0.25
"""Time without ticks from which a line is interrupted [s]; ten ticks if that is longer."""
_SPANS_MAX = 200
"""Largest number of times without safe candidate, and of other events, that are marked: the newest ones."""
_LANES = ("braking", "parameters", "goal")
"""Kinds of events with a lane of their own; the others share the last one."""
_EVENT_COLORS = palette.OUTCOMES | {
    "braking": palette.WARNING,
    "parameters": palette.BRAND,
    "goal": palette.GOAL,
}


class CurvePanel(Panel):
    """Lanes of curves and of events for each visitor, and what a click on them does.

    Args:
        page: page of the panel.
        seek: goes to a time [s].
    """

    def __init__(self, page: Page, seek: Callable[[float], object]) -> None:
        self._seek = seek
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        gui.add_html(f"<style>{STYLE}</style>")
        self._docks: dict[int, _Dock] = {}
        self.page.server.answers |= {
            CurvesMessage: self._look,
            CurvesSaveMessage: self._save,
            SeekMessage: lambda _, message: self._seek(message.time),
        }

    def welcome(self, client: viser.ClientHandle) -> None:
        self._docks[client.client_id] = _Dock(client)
        run_script(client, SCRIPT)

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        for number in set(self._docks) - set(clients):
            self._docks.pop(number, None)

    def _look(self, client: viser.ClientHandle, message: CurvesMessage) -> None:
        if (dock := self._docks.get(client.client_id)) is not None:
            dock.look(message)
            self.page.refresh()

    def _save(self, client: viser.ClientHandle, _: CurvesSaveMessage) -> None:
        dock = self._docks.get(client.client_id)
        if dock is not None and dock.saving.acquire(blocking=False):  # a long flight takes half a second
            threading.Thread(
                target=dock.save, args=(self.page.history.past(),), name="aero-viz-csv", daemon=True
            ).start()

    def update(self, frame: Frame) -> list[Change]:
        docks = [dock for dock in list(self._docks.values()) if dock.view.is_open]
        if not docks:
            return []
        past = self.page.history.past()
        return [change for dock in docks for change in dock.update(past, frame, is_playing=self.session.playing)]


class _Data:
    """The points of a chart. viser itself cannot send that there is none, so that a line is interrupted."""

    def __init__(self, client: viser.ClientHandle, chart: viser.GuiUplotHandle) -> None:
        self._client, self._chart = client, chart

    def _send(self, points: Sequence[NDArray[np.float64]]) -> None:
        sent = [
            column if np.isfinite(column).all() else [None if np.isnan(value) else value for value in column.tolist()]
            for column in points
        ]
        show(self._client, identifier(self._chart), data=sent)

    points = property(fset=_send)


class _Dock:
    """The dock of one visitor."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self.view = CurvesMessage(is_open=False, signals=None, span=None, width=1000)
        """What the visitor looks at."""
        self.lanes: list[Lane] = []
        """The lanes that are shown."""
        self.saving = threading.Lock()
        """Held from a request for the curves as a file until it is sent."""
        self._client, self._gui = client, client.gui
        self._tab = self._gui.add_panel().add_tab("Curves", viser.Icon.CHART_LINE)
        with self._tab:
            self._bar = self._gui.add_html(_bar([], ""), order=0.0)
            self._state = self._gui.add_html(_state(None, 0.0), order=1.0)
            self._events = self._gui.add_html("", order=2.0)
            self._gui.add_html('<div class="aero-ruler"><div></div></div>', order=1000.0)
            self._fork = self._gui.add_html("", order=1001.0)
        self._charts: list[viser.GuiUplotHandle] = []
        self._options: list[dict[str, Any]] = []
        self._shown: tuple[Any, ...] = ()
        self._due = 0.0

    def look(self, view: CurvesMessage) -> None:
        """Show something else from the next update on."""
        self.view, self._due = view, 0.0

    def save(self, past: Past) -> None:
        """Send the signals that are shown as CSV."""
        try:
            names = [signal.name for lane in self.lanes for signal in lane.signals]
            content = curve_lanes.table(past, names).encode()
            self._client.send_file_download("flight.csv", content, save_immediately=True)
        finally:
            self.saving.release()

    def update(self, past: Past, frame: Frame, *, is_playing: bool) -> list[Change]:
        """Return the changes that show a flight with the cursor at a frame."""
        if not len(past.rows):
            return []
        changes: list[Change] = [(self._state, "content", _state(past, frame.time))]
        now, shown = time.monotonic(), (self.view, past.version, frame.source)
        if shown == self._shown or (is_playing and now < self._due):
            return changes
        self._shown = shown
        signals = [_labelled(one, frame) for one in curve_lanes.available(past)]
        lanes = curve_lanes.chosen(signals, self.view.signals)
        buckets = max(self.view.width // _PIXELS, 50)
        gap = max(_GAP, 10.0 * frame.source.period)
        data = [curve_lanes.points(lane, past, self.view.span, buckets, gap=gap) for lane in lanes]
        ghost = past.ghost_name if len(past.ghost) else None
        options = [curve_lanes.options(lane, points, ghost) for lane, points in zip(lanes, data, strict=True)]
        if lanes != self.lanes:
            self._build(lanes, options)
        else:
            # An option that is sent again makes the page build the chart anew.
            for chart, option, before in zip(self._charts, options, self._options, strict=True):
                changes += [(chart, name, value) for name, value in option.items() if value != before[name]]
        self._options = options
        for chart, points in zip(self._charts, data, strict=True):
            changes.append((_Data(self._client, chart), "points", points))
        names = "" if ghost is None else f"solid: {'now' if ghost == 'before' else 'B'} · dashed: {ghost}"
        changes += [
            (self._bar, "content", _bar(signals, names)),
            (self._events, "content", _event_lanes(past)),
            (self._fork, "content", fork_table(past)),
        ]
        self._due = now + max(_PERIOD, 10.0 * (time.monotonic() - now))
        return changes

    def _build(self, lanes: list[Lane], options: list[dict[str, Any]]) -> None:
        """Make the charts of other lanes, without points."""
        for chart in self._charts:
            chart.remove()
        fixed: Any = {"cursor": curve_lanes.CURSOR, "padding": (5, 24, 4, 0)}
        with self._tab:
            self._charts = [
                self._gui.add_uplot(
                    tuple(np.zeros((len(option["series"]), 0))),
                    axes=curve_lanes.axes(lane),
                    height=curve_lanes.height(lane),
                    order=10.0 + row,
                    **fixed,
                    **option,
                )
                for row, (lane, option) in enumerate(zip(lanes, options, strict=True))
            ]
        self.lanes = lanes


def _labelled(one: Signal, frame: Frame) -> Signal:
    """Return a signal with the label that suits the source: only a flight in a world knows the true clearance."""
    is_from_cloud = one.name == "clearance" and not is_clearance_true(frame)
    return one._replace(label="to the cloud") if is_from_cloud else one


def _bar(signals: list[Signal], names: str) -> str:
    """Return the bar with the buttons, where the signals that are shown at first are chosen."""
    first = {signal.name for lane in curve_lanes.chosen(signals, None) for signal in lane.signals}
    groups = []
    for axis in dict.fromkeys(signal.axis for signal in signals):
        boxes = "".join(
            f'<label><input type="checkbox" value="{markup.text(signal.name)}"'
            f"{' checked' if signal.name in first else ''}>{markup.text(signal.label)}</label>"
            for signal in signals
            if signal.axis == axis
        )
        groups.append(f"<fieldset><legend>{markup.text(axis.title)}</legend>{boxes}</fieldset>")
    return (
        '<div class="aero-curves" role="toolbar" aria-label="Curves">'
        '<button class="aero-toggle aero-only-wide" data-aero="toggle"><i aria-hidden="true">▴</i>Curves</button>'
        f'<span class="aero-space aero-open">{markup.muted(names)}</span>'
        '<button class="aero-open aero-whole" data-aero="whole" hidden>Whole flight</button>'
        '<details class="aero-open"><summary><i aria-hidden="true">▴</i>Signals</summary>'
        f'<div class="aero-choice"><div>{"".join(groups)}</div></div></details>'
        '<button class="aero-open" data-aero="csv" title="Save these signals at every tick">CSV</button>'
        '<button class="aero-open" data-aero="png" title="Save a picture of the curves">PNG</button></div>'
    )


def _state(past: Past | None, now: float) -> str:
    """Return an element that tells the script which times there are."""
    if past is None:
        return '<i id="aero-curve-state" data-first="0" data-last="1" data-now="0"></i>'
    first = min(past.rows[0, 0], now)
    last = max(past.rows[-1, 0], now, *past.ghost[-1:, 0])
    differs = "" if past.differs_at is None else f"{past.differs_at:.9g}"
    return (
        f'<i id="aero-curve-state" data-first="{first:.9g}" data-last="{last:.9g}" data-now="{now:.9g}" '
        f'data-differs="{differs}"></i>'
    )


def _event_lanes(past: Past) -> str:
    """Return a lane for each kind of event that has happened."""
    lanes: dict[str, list[tuple[Event, float | None]]] = {kind: [] for kind in (*_LANES, "")}
    for event in past.events:
        if event.kind != "braking":
            lanes[event.kind if event.kind in _LANES else ""].append((event, None))
    lanes["braking"] = [(Event(begin, "braking", "no safe candidate"), end) for begin, end in _unsafe_times(past)]
    rows = []
    for marks in filter(None, lanes.values()):
        marks = marks[-_SPANS_MAX:]
        ends = [following[0].time for following in marks[1:]] + [past.rows[-1, 0] + 1e4]
        buttons = "".join(
            f'<button class="aero-event{" aero-span" if end is not None else ""}" data-aero="seek" '
            f'data-time="{event.time:.9g}" title="{event.time:.2f} s: {markup.text(event.text)}" '
            f'style="--t:{event.time:.9g};--n:{next_time if end is None else end:.9g};'
            f'--c:{css(_EVENT_COLORS.get(event.kind, palette.WARNING))}">'
            f"<span>{markup.text(event.text)}</span></button>"
            for (event, end), next_time in zip(marks, ends, strict=True)
        )
        rows.append(f'<div class="aero-lane">{buttons}</div>')
    return f'<div class="aero-lanes">{"".join(rows)}</div>'


def _unsafe_times(past: Past) -> list[tuple[float, float]]:
    """Return from when to when no candidate was safe [s]."""
    times, unsafe = past.column("time"), past.column("unsafe") > 0.5
    edges = np.diff(np.concatenate(([False], unsafe, [False])).astype(int))
    begins, ends = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    return [(float(times[b]), float(times[min(e, len(times) - 1)])) for b, e in zip(begins, ends, strict=True)]
