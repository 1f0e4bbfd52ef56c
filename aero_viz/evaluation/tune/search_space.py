"""The search space: ranges of parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aero_planner.config import DroneConfig
from aero_viz.errors import UserError

_DEFAULT_FACTOR = 4.0
"""The default range is from the value divided by this factor to the value times this factor."""


@dataclass(frozen=True)
class ParameterRange:
    """The range of values to try for one parameter."""

    path: str
    low: float
    high: float

    @property
    def is_logarithmic(self) -> bool:
        """True if the range spans a factor of 10 or more."""
        return 0.0 < 10.0 * self.low <= self.high

    def round(self, value: float) -> float:
        """Return the value rounded to four digits, within the range."""
        return min(max(float(f"{value:.4g}"), self.low), self.high)


def parse_ranges(texts: Sequence[str], config: DroneConfig) -> tuple[ParameterRange, ...]:
    """Return the ranges that texts such as "costs.q_track" or "costs.q_track=1:20" describe.

    Without limits the range is a quarter of the value in `config` to four times that value, within the parameter's
    bounds: bounds such as 0 to 1000 say little about a good range.

    Raises:
        UserError: there are no texts.
        ValueError: a parameter is unknown (the closest name is suggested), named twice, structural or not a number, or
            its range is empty, out of bounds, or missing although the value is not positive.
    """
    if not texts:
        raise UserError(
            "There is nothing to tune; name a parameter, such as --over costs.q_track or --over costs.q_track=1:20."
        )
    ranges: list[ParameterRange] = []
    for text in texts:
        name, has_limits, limits = text.partition("=")
        info = config.find(name.strip().replace("-", "_"))
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
