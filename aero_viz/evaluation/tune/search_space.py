"""The search space: ranges of parameters, and the candidates drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aero_planner import PlannerConfig
from aero_viz.errors import UserError

__all__ = ["ParameterRange", "draw_candidates", "parse_ranges"]

_DEFAULT_FACTOR = 4.0
"""The default range is from the value divided by this factor to the value times this factor."""
_MAX_HYPERCUBES = 100
"""Number of Latin hypercubes to draw before giving up on ranges whose values contradict each other."""


@dataclass(frozen=True)
class ParameterRange:
    """The range of values to try for one parameter."""

    path: str
    low: float
    high: float

    def value_at(self, fraction: float) -> float:
        """Return the value at a fraction of the range, rounded to four digits.

        The scale is logarithmic if the range spans a factor of 10 or more, and linear otherwise.
        """
        if 0.0 < 10.0 * self.low <= self.high:
            value = self.low * (self.high / self.low) ** fraction
        else:
            value = self.low + fraction * (self.high - self.low)
        return min(max(float(f"{value:.4g}"), self.low), self.high)


def parse_ranges(texts: Sequence[str], config: PlannerConfig) -> tuple[ParameterRange, ...]:
    """Return the ranges that texts such as "costs.q_track" or "costs.q_track=1:20" describe.

    Without limits the range is a quarter of the value in `config` to four times that value, within the parameter's
    bounds: bounds such as 0 to 1000 say little about a good range.

    Raises:
        UserError: there are no texts.
        ValueError: a parameter is unknown (the closest name is suggested), named twice, structural or not a number, or
            its range is empty, out of bounds, or missing although the value is not positive.
    """
    if not texts:
        raise UserError("There is nothing to tune; name a parameter, such as costs.q_track or costs.q_track=1:20.")
    ranges: list[ParameterRange] = []
    for text in texts:
        name, has_limits, limits = text.partition("=")
        info = PlannerConfig.find(name.strip().replace("-", "_"))
        value = config.get(info.path)
        if info.path in (parameter.path for parameter in ranges):
            raise ValueError(f"{info.path} is named twice; remove one.")
        if not info.live:
            raise ValueError(
                f"{info.path} is structural, but all candidates fly in one batch; name a live parameter instead."
            )
        if not isinstance(value, float):
            raise ValueError(f"{info.path} is {value!r}, which is not a number; name a numeric parameter instead.")
        if has_limits:
            try:
                low, high = (float(limit) for limit in limits.split(":"))
            except ValueError:
                raise ValueError(f"{text!r} is not a range; write {info.path}=LOW:HIGH.") from None
        elif value > 0.0:
            low, high = max(info.low, value / _DEFAULT_FACTOR), min(info.high, value * _DEFAULT_FACTOR)
        else:
            raise ValueError(f"{info.path} is {value:g}, which suggests no range; write {info.path}=LOW:HIGH.")
        parameter = ParameterRange(info.path, float(info.check(low)), float(info.check(high)))
        if parameter.low >= parameter.high:
            raise ValueError(f"{text!r} is an empty range; LOW must be less than HIGH.")
        ranges.append(parameter)
    return tuple(ranges)


def draw_candidates(
    config: PlannerConfig, ranges: Sequence[ParameterRange], count: int, *, seed: int
) -> tuple[PlannerConfig, ...]:
    """Return `count` configurations from a Latin hypercube. Values that contradict each other are drawn again.

    Args:
        config: values of all other parameters.
        ranges: parameters to vary.
        count: number of configurations.
        seed: seed of the hypercube.

    Raises:
        UserError: hardly any values in the ranges are consistent.
    """
    from scipy.stats.qmc import LatinHypercube  # takes 0.5 s to import

    hypercube = LatinHypercube(len(ranges), rng=np.random.default_rng(seed))
    candidates: list[PlannerConfig] = []
    contradiction = ""
    for _ in range(_MAX_HYPERCUBES):
        for point in hypercube.random(count):
            values = {
                parameter.path: parameter.value_at(float(fraction))
                for parameter, fraction in zip(ranges, point, strict=True)
            }
            try:
                candidates.append(config.replace(values))
            except ValueError as error:
                contradiction = str(error)
            if len(candidates) == count:
                return tuple(candidates)
    raise UserError(
        f"Hardly any values in the ranges are consistent: {contradiction} Choose ranges that fit each other."
    )
