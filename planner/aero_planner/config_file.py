"""Configurations as files: a strict subset of YAML with two levels, sections and parameters.

    preset: paper        # optional: what the file builds on; the default configuration otherwise
    costs:
      q_track: 5.0       # comment

Any YAML reader reads a saved file to the same values. Not every YAML file is one of these: lists, flow maps, anchors
and documents have no meaning here, and values that YAML versions read differently (010, 1_000, yes) are refused.
"""

from __future__ import annotations

import contextlib
import os
import re
import textwrap
from pathlib import Path
from typing import Any

from aero_planner.config import (
    SECTIONS,
    ParameterInfo,
    PlannerConfig,
    Value,
    check_section,
    did_you_mean,
    find_parameter,
    parameters,
)

__all__ = ["config_from_name", "format_config", "load_config", "save_config"]

_KEY = re.compile(r"(?P<indent> *)(?P<key>[A-Za-z_][A-Za-z0-9_-]*):(?:\s+(?P<rest>.*))?")
_QUOTED = re.compile(r"""(?:"(?P<double>[^"\\]*)"|'(?P<single>(?:[^']|'')*)')(?:\s+#.*)?""")
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}


def load_config(path: str | os.PathLike[str]) -> PlannerConfig:
    """Read a configuration file.

    Raises:
        ValueError: the file can't be read, has a line that is not understood, an unknown or repeated name, or a value
            out of its bounds; names the file, the line, and the nearest known name.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not a text file in UTF-8 (byte {error.start}); give a configuration file."
        ) from error
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror or error}.") from error
    return _parse(text, str(path))


def save_config(config: PlannerConfig, path: str | os.PathLike[str]) -> None:
    """Write every parameter of `config`; the file appears whole or not at all, in the place of an older one.

    Raises:
        ValueError: the file can't be written.
    """
    target = Path(path).resolve()
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.write(format_config(config))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise ValueError(f"{path} can't be written: {error.strerror or error}.") from error


def format_config(config: PlannerConfig) -> str:
    """Return the text of a configuration file: every parameter, with its help, range and unit as a comment."""
    lines = ["# Configuration of aero-planner. Lines may be left out; the default then applies."]
    for section, kind in SECTIONS.items():
        lines += ["", f"# {(kind.__doc__ or '').splitlines()[0]}", f"{section}:"]
        for info in parameters():
            if info.section == section:
                note = f"{info.help} [{_range(info)}]"
                lines += textwrap.wrap(
                    note, 100, initial_indent="  # ", subsequent_indent="  #   ", break_on_hyphens=False
                )
                lines.append(f"  {info.name}: {_format_value(config.get(info.path))}")
    return "\n".join(lines) + "\n"


def config_from_name(name_or_path: str | os.PathLike[str]) -> PlannerConfig:
    """Return the preset of that name, else the configuration in the file of that name.

    Raises:
        ValueError: there is neither, or the file is wrong; lists the presets.
    """
    name, presets = str(name_or_path), PlannerConfig.presets()
    if name in presets:
        return PlannerConfig.preset(name)
    if Path(name).exists():
        return load_config(name)
    raise ValueError(
        f"{name!r} is neither a preset{did_you_mean(name, presets)} nor a file; presets: {', '.join(presets)}."
    )


def _range(info: ParameterInfo) -> str:
    """Choices, or bounds and unit."""
    if info.choices:
        return ", ".join(info.choices)
    if isinstance(info.default, bool):
        return "true, false"
    return f"{info.low:g} to {info.high:g} {info.unit}".rstrip()


def _format_value(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    text = value if isinstance(value, str) else repr(value)
    # YAML 1.1 takes 1e-05 for a string: its numbers with an exponent need a point.
    if isinstance(value, float) and "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text


def _parse(text: str, path: str) -> PlannerConfig:
    values: dict[str, Value] = {}
    config, preset_given, seen = PlannerConfig(), False, set[str]()
    section = ""
    for number, line in enumerate(text.split("\n"), start=1):
        try:
            entry = _parse_line(line)
            if entry is None:
                continue
            indent, key, value = entry
            if indent == 0 and key == "preset":
                if preset_given:
                    raise ValueError("preset is given twice; remove one.")
                config, preset_given, section = PlannerConfig.preset(value), True, ""
            elif indent == 0:
                check_section(key)
                if value is not None:
                    raise ValueError(f"section {key!r} has the value {value!r}; put its parameters on lines below it.")
                if key in seen:
                    raise ValueError(f"section {key!r} is given twice; put its parameters in one place.")
                seen.add(key)
                section = key
            else:
                if not section:
                    raise ValueError(f"{key!r} stands under no section; begin one with a line such as 'costs:'.")
                info = find_parameter(f"{section}.{key}")
                if info.path in values:
                    raise ValueError(f"{info.path} is given twice; remove one.")
                if value is None:
                    raise ValueError(f"{info.path} has no value; write one after the colon or remove the line.")
                values[info.path] = info.check(value)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
    try:
        return config.replace(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _parse_line(line: str) -> tuple[int, str, Any] | None:
    """Return indentation, key and value (None where there is none) of a line, or None when it holds nothing."""
    bare = line.strip()
    if not bare or bare.startswith("#"):
        return None
    if "\t" in line:
        raise ValueError("there is a tab; use spaces.")
    match = _KEY.fullmatch(line.rstrip())
    if match is None:
        raise ValueError(f"{bare!r} is not understood; write 'section:' or, indented by two spaces, 'name: value'.")
    indent = len(match["indent"])
    if indent not in (0, 2):
        raise ValueError(
            f"{match['key']!r} is indented by {indent} spaces; use two for a parameter, none for a section."
        )
    return indent, match["key"], _parse_scalar((match["rest"] or "").strip())


def _parse_scalar(text: str) -> Any:
    """Return the value of what follows the colon, without its comment; None when nothing does."""
    if text.startswith(("'", '"')):
        quoted = _QUOTED.fullmatch(text)
        if quoted is None:
            raise ValueError(f"{text} has no matching quote at its end, or a backslash, which has no meaning here.")
        return quoted["double"] if quoted["double"] is not None else quoted["single"].replace("''", "'")
    text = re.split(r"(?:^|\s)#", text, maxsplit=1)[0].rstrip()
    if not text:
        return None
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    return text
