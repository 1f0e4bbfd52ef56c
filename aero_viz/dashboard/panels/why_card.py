"""HTML of the explanation of a plan: the terms of all instances, and the card of one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from aero_planner import registry
from aero_planner.cost_terms import CostTerms
from aero_planner.models.vehicle_model import VehicleModel
from aero_viz.cost_text import cost_text
from aero_viz.dashboard import palette
from aero_viz.dashboard.palette import Rgb, css
from aero_viz.dashboard.panels import markup
from aero_viz.explain.evidence import Evidence, PlanEvidence
from aero_viz.explain.verdict import closest, verdict

Array = NDArray[np.float64]
_TAB20 = palette.as_rgb(palette.colormap("tab20"))
_COLORS: list[Rgb] = [_TAB20[i] for i in (0, 4, 5, 6, 8, 16, 2, 12, 1, 18, 3, 9, 17, 7, 19, 13, 10, 11, 14, 15)]
"""Colours of the terms of S2, in their order; those of terms beyond the last colour begin again."""
_WIDTH, _HEIGHT = 290, 40
NUMBERED_MAX = 40
"""Largest number of candidates that are shown with their numbers; of more, a click in the scene selects one."""


def chart(evidence: PlanEvidence, selected: int | None) -> str:
    """Return a column for each candidate: the terms by which its cost exceeds the smallest value of each term."""
    plan = evidence.plan
    if isinstance(evidence, Evidence):
        costs, name = evidence.stage2, "S2"
        names, terms = [term.label for term in costs.terms], costs.values.sum(axis=2, dtype=np.float64).T
    else:
        name, names = "cost", list(plan.costs)
        terms = np.array(list(plan.costs.values()), dtype=np.float64).reshape(len(names), len(plan.kinds))
    colors = [_COLORS[i % len(_COLORS)] for i in range(len(names))]
    excess = terms - terms.min(axis=1, keepdims=True)
    total = excess.sum(axis=0)
    height = np.log1p(total) / max(float(np.log1p(total).max()), 1e-9)
    columns = numbers = ""
    are_numbered = len(plan.kinds) <= NUMBERED_MAX
    for m, kind in enumerate(plan.kinds):
        parts = "".join(
            f'<div style="height:{100.0 * part / max(total[m], 1e-9):.1f}%;background:{css(color)}"></div>'
            for color, part in zip(colors, excess[:, m], strict=True)
            if part > 0.0
        )
        label = f"{m} {kind}: {name} {cost_text(plan.cost[m])}, " + ", ".join(
            f"{name} {cost_text(value)}" for name, value in zip(names, terms[:, m], strict=True) if value
        )
        mark = palette.SELECTED if m == selected else palette.CHOSEN if m == plan.best else None
        outline = "" if mark is None else f";outline:2px solid {css(mark)}"
        faint = "" if evidence.is_safe[m] else ";opacity:0.45"
        columns += (
            f'<div class="aero-terms" data-instance="{m}" title="{markup.text(label)}" '
            f'style="flex:1;height:{max(4.0, 100.0 * height[m]):.0f}%{outline}{faint}">{parts}</div>'
        )
        style = f"color:{css(palette.SELECTED)};font-weight:700" if m == selected else ""
        number = m if are_numbered else ""
        numbers += f'<div class="aero-number" style="flex:1;text-align:center;min-width:0;{style}">{number}</div>'
    shown = [(name, color) for name, color, row in zip(names, colors, excess, strict=True) if row.max() > 0.0]
    heading = markup.heading(f"{name} above the least of each term, log.: shorter is better", "faint: unsafe")
    bars = f'<div style="display:flex;align-items:flex-end;gap:3px;height:76px;margin:4px 0 0">{columns}</div>'
    bars += f'<div style="display:flex;gap:3px;font-size:9px;margin-bottom:4px">{numbers}</div>'
    return heading + bars + markup.key(shown)


def card(evidence: PlanEvidence, instance: int) -> str:
    """Return the card of a candidate; of AERO-MPPI's instances with everything that led to them."""
    return _card(evidence, instance) if isinstance(evidence, Evidence) else _path_card(evidence, instance)


def _path_card(evidence: PlanEvidence, candidate: int) -> str:
    """Return the costs of a candidate next to those of the chosen one."""
    plan, best = evidence.plan, int(evidence.plan.best)
    safe = "safe" if evidence.is_safe[candidate] else "not safe"
    title = markup.pill(f"candidate {candidate}: {plan.kinds[candidate]}, {safe}", palette.SELECTED)
    costs = {**plan.costs, "all": plan.cost}
    rows = [(name, *(cost_text(float(cost[m])) for m in (candidate, best))) for name, cost in costs.items()]
    table = markup.columns(("cost", f"{candidate}", f"chosen: {best}"), rows)
    missing = markup.note("This planner has no samples, weights and terms over time: the costs are all that it tells.")
    return f'<div style="margin:6px 0 4px">{title}</div><div class="aero-term-table">{table}</div>{missing}'


def _card(evidence: Evidence, instance: int) -> str:
    """Return the card of an instance."""
    plan, config = evidence.plan, evidence.frame.config
    first, second = evidence.stage1.values[instance], evidence.stage2.values[instance]
    distance, time, name = closest(evidence, instance)
    weights, asked = np.sort(evidence.weights[instance])[::-1], evidence.safety.demanded_clearance
    kind = plan.kinds[instance]
    sentence = f'<div class="aero-verdict" style="font-weight:600">{markup.text(verdict(evidence, instance))}</div>'
    rest = "" if evidence.is_exact else markup.note("Planned again with small differences: another device.")
    return "".join(
        (
            f'<div style="margin:6px 0 4px">{markup.pill(f"instance {instance}: {kind}", palette.SELECTED)}</div>',
            sentence,
            rest,
            _table(evidence, instance),
            _plot("S1 of its best sample over the steps", [first.sum(axis=0)], is_log=True),
            _plot("S2 over the steps", [second.sum(axis=0)], is_log=True),
            _plot(
                f"clearance of its rollout [m]: least {distance:.2f} at {time:.2f} s, {name}; dashed: {asked:.2f} is "
                f"asked at rest, from {config.costs.distance_max:.2f} on it costs nothing",
                [np.minimum(evidence.distance[instance], 2.0)],
                bounds=(asked, config.costs.distance_max),
                low=0.0,
            ),
            markup.heading("effective samples", f"{evidence.effective_samples(instance):.1f} of {len(weights)}"),
            _weights(weights),
            *_controls(evidence, instance),
        )
    )


def _table(evidence: Evidence, instance: int) -> str:
    """Return S1 of the best sample and S2 by term."""
    sums = [_sums(costs, instance) for costs in (evidence.stage1, evidence.stage2)]
    labels = {term.name: term.label for costs in (evidence.stage1, evidence.stage2) for term in costs.terms}
    rows = ""
    for name, label in labels.items():
        if any(by_term.get(name) for by_term in sums):
            left, right = (cost_text(by_term[name]) if name in by_term else "" for by_term in sums)
            rows += f"<div>{markup.muted(label)}</div><div>{left}</div><div>{right}</div>"
    first, second = (sum(by_term.values()) for by_term in sums)
    return (
        '<div class="aero-term-table" style="display:grid;grid-template-columns:1fr auto auto;gap:1px 12px;'
        f'text-align:right;margin:6px 0"><div></div><div>S1</div><div>S2</div>{rows}'
        f"<div>all</div><div>{cost_text(first)}</div><div>{cost_text(second)}</div></div>"
    )


def _sums(costs: CostTerms, row: int) -> dict[str, float]:
    """Return the terms of a rollout, summed over its steps, by name."""
    sums = costs.values[row].sum(axis=1, dtype=np.float64)
    return {term.name: float(value) for term, value in zip(costs.terms, sums, strict=True)}


def _weights(weights: Array, most: int = 24) -> str:
    columns = "".join(
        f'<div title="{weight:.3f}" style="flex:1;height:{max(3.0, 100.0 * weight / weights[0]):.0f}%;'
        f'background:{css(palette.SELECTED)}"></div>'
        for weight in weights[:most]
    )
    label = f"largest {min(most, len(weights))} weights: {weights[0]:.2f}, {weights[min(1, len(weights) - 1)]:.2f}, .."
    bars = f'<div style="display:flex;align-items:flex-end;gap:1px;height:26px">{columns}</div>'
    return f'<div class="aero-weights">{markup.muted(label)}{bars}</div>'


def _controls(evidence: Evidence, instance: int) -> list[str]:
    """Return a plot of each control, with its bounds where each has its own."""
    v, controls = evidence.frame.config.vehicle, evidence.plan.controls[instance].astype(np.float64)
    model: VehicleModel = registry.load("models", v.model)
    ends = {"F_t": (v.thrust_min, v.thrust_max)}
    ends |= dict.fromkeys(("omega_x", "omega_y"), (-v.rate_xy_max, v.rate_xy_max))
    ends |= dict.fromkeys(("omega_z", "yaw_rate"), (-v.rate_z_max, v.rate_z_max))
    plots = []
    for value, (name, unit) in zip(controls.T, model.controls, strict=True):
        label, bounds = f"{name} [{unit}]", ends.get(name)
        if bounds is None:
            plots.append(_plot(label, [value]))
            continue
        at_bound = int(np.count_nonzero((value <= bounds[0] + 1e-3) | (value >= bounds[1] - 1e-3)))
        label += f" in {bounds[0]:g} .. {bounds[1]:g}" + (f", {at_bound} at a bound" if at_bound else "")
        plots.append(_plot(label, [value], bounds=bounds, low=bounds[0], high=bounds[1]))
    return plots


def _plot(
    label: str,
    curves: Sequence[Array],
    *,
    bounds: Sequence[float] = (),
    low: float | None = None,
    high: float | None = None,
    is_log: bool = False,
) -> str:
    """Return curves over the steps of a plan, with dashed lines at bounds."""
    values = [np.log1p(np.maximum(curve, 0.0)) if is_log else curve for curve in curves]
    bottom = min(float(min(curve.min() for curve in values)), *bounds, np.inf) if low is None else low
    top = max(float(max(curve.max() for curve in values)), *bounds, -np.inf) if high is None else high
    scale = (_HEIGHT - 4) / max(top - bottom, 1e-9)

    def y(value: float) -> float:
        return _HEIGHT - 2 - (float(value) - bottom) * scale

    lines = "".join(
        f'<line x1="0" x2="{_WIDTH}" y1="{y(bound):.1f}" y2="{y(bound):.1f}" stroke="{css(palette.WARNING)}" '
        f'stroke-dasharray="4 3"/>'
        for bound in bounds
    )
    for curve in values:
        x = np.linspace(0.0, _WIDTH, len(curve))
        points = " ".join(f"{a:.1f},{y(b):.1f}" for a, b in zip(x, curve, strict=True))
        lines += f'<polyline points="{points}" fill="none" stroke="{css(palette.SELECTED)}" stroke-width="1.6"/>'
    ends = f"{cost_text(curves[0].min())} .. {cost_text(curves[0].max())}"
    return (
        f'<div style="font-size:11px">{markup.heading(label, ends)}</div><svg class="aero-plot" '
        f'viewBox="0 0 {_WIDTH} {_HEIGHT}" preserveAspectRatio="none" '
        f'style="display:block;width:100%;height:{_HEIGHT}px;background:{css(palette.MUTED, 0.10)}">{lines}</svg>'
    )
