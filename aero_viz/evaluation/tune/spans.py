"""What is tried: ranges of parameters, and candidates drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aero_planner import PlannerConfig
from aero_planner.config import find_parameter
from aero_viz.errors import UserError

__all__ = ["Span", "draw", "parse_spans"]

_REACH = 4.0  # bounds such as 0 to 1000 leave no feeling for a 3: without a range, a quarter of it to four times it
_SETS = 100  # Latin hypercubes that are drawn before it is said that hardly any values fit each other


@dataclass(frozen=True)
class Span:
    """The range in which values of one parameter are tried."""

    path: str
    low: float
    high: float

    def at(self, share: float) -> float:
        """Return the value at a share of the range, 0 to 1, to four digits: by ratio where it spans a factor of 10."""
        if 0.0 < 10.0 * self.low <= self.high:
            value = self.low * (self.high / self.low) ** share
        else:
            value = self.low + share * (self.high - self.low)
        return min(max(float(f"{value:.4g}"), self.low), self.high)


def parse_spans(texts: Sequence[str], config: PlannerConfig) -> tuple[Span, ...]:
    """Return what to try from PATH or PATH=LOW:HIGH, such as "costs.q_track=1:20".

    Without a range it is a quarter of the incumbent's value to four times it, within the parameter's bounds.

    Raises:
        UserError: there is nothing to try.
        ValueError: a name is unknown (the nearest is suggested), given twice, structural or no number, or a range is
            empty, out of bounds, or missing where the value is not positive.
    """
    if not texts:
        raise UserError("There is nothing to tune; give --over with a parameter, such as --over costs.q_track=1:20.")
    spans: list[Span] = []
    for text in texts:
        name, given, bounds = text.partition("=")
        info = find_parameter(name.strip().replace("-", "_"))
        value = config.get(info.path)
        if info.path in (span.path for span in spans):
            raise ValueError(f"{info.path} is given twice; remove one.")
        if not info.live:
            raise ValueError(f"{info.path} is structural, and candidates fly in one batch; give a live parameter.")
        if not isinstance(value, float):
            raise ValueError(f"{info.path} is {value!r}, which is no number; give a parameter that is one.")
        if given:
            try:
                low, high = (float(bound) for bound in bounds.split(":"))
            except ValueError:
                raise ValueError(f"--over {text} is not understood; write {info.path}=LOW:HIGH.") from None
        elif value > 0.0:
            low, high = max(info.low, value / _REACH), min(info.high, value * _REACH)
        else:
            raise ValueError(f"{info.path} is {value:g}, which suggests no range; write {info.path}=LOW:HIGH.")
        span = Span(info.path, float(info.check(low)), float(info.check(high)))
        if span.low >= span.high:
            raise ValueError(f"--over {text} is an empty range; LOW must be less than HIGH.")
        spans.append(span)
    return tuple(spans)


def draw(config: PlannerConfig, spans: Sequence[Span], count: int, *, seed: int) -> tuple[PlannerConfig, ...]:
    """Return `count` configurations from a Latin hypercube; values that contradict each other are drawn anew.

    What is not tried is that of `config`.

    Raises:
        UserError: hardly any values fit each other.
    """
    generator = np.random.default_rng(seed)
    candidates: list[PlannerConfig] = []
    contradiction = ""
    for _ in range(_SETS):
        strata = generator.permuted(np.tile(np.arange(count), (len(spans), 1)), axis=1)
        for shares in ((strata + generator.random(strata.shape)) / count).T:
            values = {span.path: span.at(float(share)) for span, share in zip(spans, shares, strict=True)}
            try:
                candidates.append(config.replace(values))
            except ValueError as error:
                contradiction = str(error)
            if len(candidates) == count:
                return tuple(candidates)
    raise UserError(f"Hardly any values of the ranges fit each other: {contradiction} Give --over ranges that do.")
