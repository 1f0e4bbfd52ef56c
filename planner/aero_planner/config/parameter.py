"""What is known of a parameter, and the fields from which the configuration is made."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

__all__ = ["ParameterInfo", "Value", "choice", "did_you_mean", "live", "structural", "switch"]

Value = float | int | bool | str


@dataclass(frozen=True)
class ParameterInfo:
    """What is known of one parameter besides its value."""

    section: str
    name: str
    default: Value
    unit: str
    help: str
    low: float = -math.inf
    high: float = math.inf
    scale: Literal["linear", "log"] = "linear"
    choices: tuple[str, ...] = ()
    live: bool = True
    symbol: str = ""

    @property
    def path(self) -> str:
        """Name with its section, such as "costs.q_track"."""
        return f"{self.section}.{self.name}"

    def check(self, value: Any) -> Value:
        """Return `value` in this parameter's type; NumPy scalars count as numbers, and 128.0 as a whole one.

        Raises:
            ValueError: the value has the wrong type or lies outside the bounds; names field, value and range.
        """
        kind = type(self.default)
        if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
            value = value.item()
        if self.choices:
            valid, wanted = isinstance(value, str) and value in self.choices, f"one of {', '.join(self.choices)}"
        elif kind is bool:
            valid, wanted = isinstance(value, bool), "true or false"
        else:
            valid = isinstance(value, int | float) and not isinstance(value, bool)
            valid = valid and self.low <= value <= self.high and (kind is float or value == int(value))
            wanted = f"{'a whole' if kind is int else 'a'} number in [{self.low:g}, {self.high:g}] {self.unit}".rstrip()
        if not valid:
            raise ValueError(f"{self.path} is {value!r}; it must be {wanted}.")
        return kind(value)


def live(
    default: Any, unit: str, low: float, high: float, help: str, *, scale: str = "linear", symbol: str = ""
) -> Any:
    """Return the field of a number in device memory, which may change between two plans."""
    info = dict(unit=unit, low=low, high=high, help=help, scale=scale, symbol=symbol, live=True)
    return field(default=default, metadata=info)


def switch(default: bool, help: str, *, live: bool = True) -> Any:
    """Return the field of a truth value."""
    return field(default=default, metadata=dict(unit="", help=help, live=live, low=0.0, high=1.0))


def choice(default: str, choices: tuple[str, ...], help: str) -> Any:
    """Return the field of a live name out of several."""
    return field(default=default, metadata=dict(unit="", help=help, choices=choices, live=True))


def structural(default: int, low: float, high: float, help: str, *, symbol: str = "") -> Any:
    """Return the field of a whole number that sizes buffers."""
    return field(default=default, metadata=dict(unit="", low=low, high=high, help=help, symbol=symbol, live=False))


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """Return ", did you mean ..?" with the known name nearest to `name`, or nothing when none is near."""
    close = difflib.get_close_matches(str(name), list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
