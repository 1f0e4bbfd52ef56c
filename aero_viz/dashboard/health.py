"""Health of the planner over the last seconds: what its arrays say about its settings, and what to try."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aero_planner import Plan, PlannerConfig
from aero_planner.config import DroneConfig
from aero_viz.dashboard.advice import Advice
from aero_viz.dashboard.signals import effective_samples
from aero_viz.planners.plan import ensemble
from aero_viz.session.frame import Frame
from aero_viz.session.safety import known_safe

Array = NDArray[np.float64]
_MODEL = "ctbr"
"""Vehicle model whose controls have bounds of their own."""
_AT_BOUND = 1e-3
"""Distance to a bound from which a control is at it [N, rad/s]."""


@dataclass(frozen=True)
class Reading:
    """One figure of the health."""

    label: str
    value: str
    healthy: str
    """Range of health."""
    meaning: str
    """What a value outside it means."""
    is_healthy: bool
    advice: Advice | None
    """What to try while it is not healthy; None also where nothing is known that would help."""


def readings(frames: Sequence[Frame]) -> list[Reading]:
    """Return the health over some frames of one flight with one configuration, the newest one last.

    Of a planner other than AERO-MPPI only what every plan tells: safe candidates, the spread of their costs, and times.
    """
    config = frames[-1].config
    plans = [plan for frame in frames if (plan := ensemble(frame.plan)) is not None]
    own = config if isinstance(config, PlannerConfig) and len(plans) == len(frames) else None
    found: list[Reading | None] = []
    if own is not None:
        found += [reading(plans, own) for reading in (_effective, _controls, _samples, _tracking)]
    found += [_spread(frames, own), _safe(frames, config), _time(frames, own)]
    return [reading for reading in found if reading is not None]


def _mean(plans: Sequence[Plan], value: Callable[[Plan], float]) -> float:
    return float(np.mean([value(plan) for plan in plans]))


def _effective(plans: Sequence[Plan], config: PlannerConfig) -> Reading:
    count, asked = config.sampling.samples, config.sampling.effective_samples
    size = _mean(plans, lambda plan: effective_samples(plan, plan.best))
    low, high = (0.04 * count, 0.5 * count) if asked == 0.0 else (min(2.0, 0.5 * asked), 0.5 * count)
    meaning = (
        "The update takes the best sample alone, and its noise: raise the temperature."
        if size < low
        else "The update averages good and bad samples alike: average over fewer."
    )
    advice = Advice("sampling.effective_samples", float(round(0.05 * count)))
    if size < low:  # the largest temperature limits it
        advice = Advice("sampling.temperature", _temperature_for(plans[-1], asked or 0.12 * count))
    value, healthy = f"{size:.1f} of {count}", f"{low:.0f} to {high:.0f}"
    return _reading("effective samples", value, healthy, meaning, low <= size <= high, advice)


def _temperature_for(plan: Plan, size: float) -> float:
    """Return the temperature at which the chosen instance would have had an effective sample size."""
    info = PlannerConfig.find("sampling.temperature")
    low, high = math.log(info.low), math.log(info.high)
    for _ in range(40):
        middle = 0.5 * (low + high)
        is_less = effective_samples(plan, plan.best, math.exp(middle)) < size
        low, high = (middle, high) if is_less else (low, middle)
    return float(f"{math.exp(high):.2g}")


def _bounds(config: PlannerConfig) -> tuple[Array, Array]:
    v = config.vehicle
    high = np.array([v.thrust_max, v.rate_xy_max, v.rate_xy_max, v.rate_z_max])
    return np.array([v.thrust_min, *-high[1:]]), high


def _controls(plans: Sequence[Plan], config: PlannerConfig) -> Reading | None:
    if config.vehicle.model != _MODEL:
        return None
    low, high = _bounds(config)

    def share(plan: Plan) -> float:
        controls = plan.controls
        return float(((controls <= low + _AT_BOUND) | (controls >= high - _AT_BOUND)).mean())

    value = _mean(plans, share)
    meaning = "The candidates ask for more than the drone can do: make control effort dearer, or fly slower."
    advice = Advice("costs.q_control", float(f"{2.0 * max(config.costs.q_control, 0.05):.2g}"))
    return _reading("controls at bounds", f"{value:.0%}", "at most 20%", meaning, value <= 0.2, advice)


def _samples(plans: Sequence[Plan], config: PlannerConfig) -> Reading | None:
    if config.vehicle.model != _MODEL:
        return None
    low, high = _bounds(config)
    s = config.sampling
    names = ("variance_thrust", "variance_rate_xy", "variance_rate_xy", "variance_rate_z")
    deviation = np.sqrt([max(getattr(s, name), 1e-12) for name in names])
    below = np.vectorize(lambda x: 0.5 * math.erfc(-x / math.sqrt(2.0)))

    def share(plan: Plan) -> Array:
        """Return the share of the noise that the bounds cut off around the chosen controls, by control, shape [4]."""
        controls = plan.command.astype(np.float64)
        return (below((low - controls) / deviation) + below((controls - high) / deviation)).mean(axis=0)

    by_control = np.mean([share(plan) for plan in plans[-10:]], axis=0)
    value, worst = float(by_control.mean()), names[int(by_control.argmax())]
    meaning = "The bounds cut off much of the noise, so that samples repeat each other: draw less noise."
    advice = Advice(f"sampling.{worst}", float(f"{0.5 * getattr(s, worst):.2g}"))
    return _reading("samples at bounds", f"{value:.0%} expected", "at most 30%", meaning, value <= 0.3, advice)


def _tracking(plans: Sequence[Plan], config: PlannerConfig) -> Reading:
    anchors = config.anchor_count

    def error(plan: Plan) -> float:
        return float(np.linalg.norm(plan.positions[:anchors] - plan.guides[:anchors], axis=-1).mean())

    value, limit = _mean(plans, error), 0.15 * config.lookahead
    meaning = "Rollouts leave their guides, so that anchors no longer spread them: weigh the tracking more."
    advice = Advice("costs.q_track", float(f"{1.5 * max(config.costs.q_track, 1.0):.3g}"))
    return _reading("distance from guides", f"{value:.2f} m", f"at most {limit:.2f} m", meaning, value <= limit, advice)


def _spread(frames: Sequence[Frame], config: PlannerConfig | None) -> Reading | None:
    """Return how far apart the costs of candidates are; None where there is never a choice between two."""
    shares: list[float] = []
    for frame in frames:
        cost, safe = frame.plan.cost.astype(np.float64), known_safe(frame)
        cost = cost[safe] if safe.any() else cost
        cost = cost[np.isfinite(cost)]  # an infinite cost rules a candidate out
        if len(frame.plan.kinds) > 1 and len(cost):
            shares.append(float((np.median(cost) - cost.min()) / max(abs(cost.min()), 1.0)))
    if not shares:
        return None
    value = float(np.mean(shares))
    meaning, advice = "The candidates cost nearly the same, so that little decides between them", None
    if config is not None:
        meaning += ": weigh the goal more"
        advice = Advice("costs.q_position", float(f"{1.5 * config.costs.q_position:.3g}"))
    label = "spread of costs" if config is None else "spread of S2"
    return _reading(label, f"{value:.1%}", "at least 0.5%", f"{meaning}.", value >= 0.005, advice)


def _safe(frames: Sequence[Frame], config: DroneConfig) -> Reading:
    value = float(np.mean([known_safe(frame).mean() for frame in frames]))
    limit = "at most " if any(frame.is_safe is None for frame in frames) else ""
    meaning = "Few candidates are safe: the drone is too fast for what it sees, or asks for too much clearance."
    advice = Advice("vehicle.speed_limit", float(f"{0.8 * config.vehicle.speed_limit:.2g}"))
    return _reading("safe candidates", f"{limit}{value:.0%}", "at least 30%", meaning, value >= 0.3, advice)


def _time(frames: Sequence[Frame], config: PlannerConfig | None) -> Reading:
    times = [frame.timings_ms.get("plan", 0.0) for frame in frames]
    period = 1e3 * frames[-1].source.period
    value = float(np.median(times))
    meaning, advice = "Planning takes too long for its period", None
    if config is not None and config.sampling.samples > 1:
        meaning += ": draw fewer samples"
        advice = Advice("sampling.samples", max(config.sampling.samples // 2, 1))
    is_healthy = value <= 0.8 * period
    return _reading("plan time", f"{value:.1f} of {period:.0f} ms", "at most 80%", f"{meaning}.", is_healthy, advice)


def _reading(label: str, value: str, healthy: str, meaning: str, is_healthy: bool, advice: Advice | None) -> Reading:
    return Reading(label, value, healthy, meaning, is_healthy, None if is_healthy else advice)
