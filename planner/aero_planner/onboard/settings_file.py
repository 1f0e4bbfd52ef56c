"""The node's settings as files: the planner's strict subset of YAML, one level deeper.

A file keeps them under `onboard:`, beside the planner's sections, so that one tuned file is all that a drone needs:

    preset: default
    costs:
      q_track: 5.0
    onboard:
      limits:
        plan_age: 0.25   # comment

or it holds nothing else, and then the line `onboard:` may be left out, with what is below it two spaces to the left.
"""

from __future__ import annotations

import os
import textwrap

from aero_planner.config import PlannerConfig
from aero_planner.config.file import (
    format_value,
    parse_config,
    parse_line,
    read_text,
    split_onboard,
)
from aero_planner.config.parameter import Value
from aero_planner.onboard.settings import OnboardConfig

__all__ = ["format_onboard", "load_file", "load_flight_config", "load_onboard"]


def load_flight_config(path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Read the planner's configuration and, from under `onboard:`, the node's; what is missing is the default.

    Raises:
        ValueError: the file can't be read, has a line that is not understood, an unknown or repeated name, or a value
            out of its bounds; names the file, the line, and the nearest known name.
    """
    planner, onboard, _ = split_onboard(read_text(path), str(path))
    return parse_config(planner, str(path)), _parse_onboard(onboard, str(path))


def load_onboard(path: str | os.PathLike[str]) -> OnboardConfig:
    """Read the node's settings from a file of their own, with or without the line `onboard:`.

    Raises:
        ValueError: as `load_flight_config`; also where the file holds planner parameters as well.
    """
    planner, onboard, found = split_onboard(read_text(path), str(path))
    if not found:
        return _parse_onboard(planner, str(path))
    for number, line in enumerate(planner.split("\n"), start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            raise ValueError(
                f"{path}, line {number}: {line.strip()!r} is none of the node's settings, which stand under "
                "'onboard:'; give a file with both as --config."
            )
    return _parse_onboard(onboard, str(path))


def load_file(path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Read a file of any of the forms: planner's parameters, node's settings, or both; ValueError as above."""
    first = next(
        (line for line in read_text(path).split("\n") if line.strip() and not line.lstrip().startswith("#")), ""
    )
    if first.partition(":")[0] in OnboardConfig.sections():
        return PlannerConfig(), load_onboard(path)
    return load_flight_config(path)


def format_onboard(config: OnboardConfig) -> str:
    """Return the text of the `onboard:` part of a file: every setting, with its help, range and unit as a comment."""
    lines = ["onboard:"]
    for section, kind in OnboardConfig.sections().items():
        lines += ["", f"  # {(kind.__doc__ or '').splitlines()[0]}", f"  {section}:"]
        for info in kind.parameters():
            lines += textwrap.wrap(
                f"{info.help} [{info.range}]", 100, initial_indent="    # ", subsequent_indent="    #   ",
                break_on_hyphens=False,
            )  # fmt: skip
            value = config.get(info.path)
            # A word may look like a number, and holds no quotes.
            lines.append(f"    {info.name}: {repr(value) if info.pattern else format_value(value)}")
    return "\n".join(lines) + "\n"


def _parse_onboard(content: str, path: str) -> OnboardConfig:
    values: dict[str, Value] = {}
    seen: set[str] = set()
    section = ""
    for number, line in enumerate(content.split("\n"), start=1):
        try:
            entry = parse_line(line)
            if entry is None:
                continue
            indent, key, value = entry
            if indent == 0:
                OnboardConfig.check_section(key)
                if value is not None:
                    raise ValueError(f"section {key!r} has the value {value!r}; put its settings on lines below it.")
                if key in seen:
                    raise ValueError(f"section {key!r} is given twice; put its settings in one place.")
                seen.add(key)
                section = key
                continue
            if not section:
                raise ValueError(f"{key!r} stands under no section; begin one with a line such as 'limits:'.")
            info = OnboardConfig.find(f"{section}.{key}")
            if info.path in values:
                raise ValueError(f"{info.path} is given twice; remove one.")
            if value is None:
                raise ValueError(f"{info.path} has no value; write one after the colon or remove the line.")
            values[info.path] = info.check(value)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
    try:
        return OnboardConfig().replace(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
