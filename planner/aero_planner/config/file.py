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
    PlannerConfig,
    Value,
    did_you_mean,
    find_parameter,
    parameters,
)

__all__ = [
    "config_from_name",
    "format_config",
    "format_value",
    "is_empty",
    "load_config",
    "parse_config",
    "parse_line",
    "read_text",
    "save_config",
    "split_onboard",
]

_KEY = re.compile(r"(?P<indent> *)(?P<key>[A-Za-z_][A-Za-z0-9_-]*):(?:\s+(?P<rest>.*))?")
_QUOTED = re.compile(r"""(?:"(?P<double>[^"\\]*)"|'(?P<single>(?:[^']|'')*)')(?:\s+#.*)?""")
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}


def load_config(path: str | os.PathLike[str]) -> PlannerConfig:
    """Read a configuration file; what it holds under `onboard:`, for the node that flies, is left out.

    Raises:
        ValueError: the file can't be read, has a line that is not understood, an unknown or repeated name, or a value
            out of its bounds; names the file, the line, and the nearest known name.
    """
    return parse_config(split_onboard(read_text(path), str(path))[0], str(path))


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a configuration file; ValueError where it can't be read."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not a text file in UTF-8 (byte {error.start}); give a configuration file."
        ) from error
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror or error}.") from error


def is_empty(content: str) -> bool:
    """Return whether a configuration file holds nothing but blank lines and comments."""
    return all(not line.strip() or line.lstrip().startswith("#") for line in content.split("\n"))


def split_onboard(content: str, path: str) -> tuple[str, str, bool]:
    """Return the lines outside and inside of `onboard:`, each on the line where it was, and whether there is one."""
    outside: list[str] = []
    inside: list[str] = []
    within = found = False
    for number, line in enumerate(content.split("\n"), start=1):
        bare = line.strip()
        if bare and not bare.startswith("#") and not line.startswith(" "):
            within = re.match(r"onboard:(\s|$)", line) is not None
            if within:
                if found:
                    raise ValueError(f"{path}, line {number}: 'onboard' is given twice; put its sections in one place.")
                if not re.fullmatch(r"onboard:\s*(#.*)?", line):
                    raise ValueError(f"{path}, line {number}: put the sections of 'onboard' on lines below it.")
                found = True
                line = ""
        if within and bare and not bare.startswith("#") and line:
            indent = len(line) - len(line.lstrip(" "))
            if indent not in (2, 4):
                raise ValueError(
                    f"{path}, line {number}: {bare!r} is indented by {indent} spaces; below 'onboard' use two for a "
                    "section, four for a setting."
                )
            line = line[2:]
        inside.append(line if within else "")
        outside.append("" if within else line)
    return "\n".join(outside), "\n".join(inside), found


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
    for section, kind in PlannerConfig.sections().items():
        lines += ["", f"# {(kind.__doc__ or '').splitlines()[0]}", f"{section}:"]
        for info in parameters():
            if info.section == section:
                note = f"{info.help} [{info.range}]"
                lines += textwrap.wrap(
                    note, 100, initial_indent="  # ", subsequent_indent="  #   ", break_on_hyphens=False
                )
                lines.append(f"  {info.name}: {format_value(config.get(info.path))}")
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


def format_value(value: Value) -> str:
    """Return a value as YAML reads it back."""
    if isinstance(value, bool):
        return "true" if value else "false"
    text = value if isinstance(value, str) else repr(value)
    # YAML 1.1 takes 1e-05 for a string: its numbers with an exponent need a point.
    if isinstance(value, float) and "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text


def parse_config(text: str, path: str) -> PlannerConfig:
    """Return the configuration that `text` says; `path` is named in errors, see `load_config`."""
    values: dict[str, Value] = {}
    config, preset_given, seen = PlannerConfig(), False, set[str]()
    section = ""
    for number, line in enumerate(text.split("\n"), start=1):
        try:
            entry = parse_line(line)
            if entry is None:
                continue
            indent, key, value = entry
            if indent == 0 and key == "preset":
                if preset_given:
                    raise ValueError("preset is given twice; remove one.")
                config, preset_given, section = PlannerConfig.preset(value), True, ""
            elif indent == 0:
                PlannerConfig.check_section(key)
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


def parse_line(line: str) -> tuple[int, str, Any] | None:
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
