"""Random configurations, and files for them."""

from pathlib import Path
from typing import TypeVar

from hypothesis import strategies as st

from aero_planner.config import ParameterInfo, SectionedConfig, Value

Config = TypeVar("Config", bound=SectionedConfig)


def values_of(info: ParameterInfo) -> st.SearchStrategy:
    """Return a strategy for the valid values of a parameter."""
    if info.items:
        return st.lists(st.sampled_from(info.items)).map(", ".join)
    if info.pattern:
        return st.from_regex(info.pattern, fullmatch=True).filter(str.isascii)
    if info.choices:
        return st.sampled_from(info.choices)
    if isinstance(info.default, bool):
        return st.booleans()
    if isinstance(info.default, int):
        return st.integers(int(info.low), int(info.high))
    # Includes subnormal and tiny values if a bound is zero; they are written with an exponent.
    return st.floats(info.low, info.high)


def other_value(info: ParameterInfo) -> Value:
    """Return a value of a number or a switch that is not the default, but near enough to contradict no other one."""
    if isinstance(info.default, bool):
        return not info.default
    assert isinstance(info.default, float)
    return info.default + 0.1 * (info.high - info.default or info.low - info.default)


@st.composite
def configs(draw: st.DrawFn, kind: type[Config]) -> Config:
    """Draw a configuration of a kind in which up to twelve values are not the default."""
    chosen = draw(st.lists(st.sampled_from(kind.parameters()), unique=True, max_size=12))
    try:
        return kind().replace({info.path: draw(values_of(info)) for info in chosen})
    except ValueError:  # values that contradict each other
        return kind()


def write(path: Path, text: str) -> Path:
    """Write a file as it is, without conversion of line ends, and return its path."""
    path.write_text(text, encoding="utf-8", newline="")
    return path
