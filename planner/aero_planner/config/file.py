"""Configuration files: YAML with two levels, sections and parameters.

planner: primitives  # optional: the planner that is configured; AERO-MPPI otherwise
preset: paper        # optional: the configuration that the file changes; the default configuration otherwise
costs:
  q_track: 5.0       # comment
onboard:             # optional: settings of the node on the drone, one level deeper
  limits:
    plan_age: 0.25
goal:                # optional: goal of a preset that was saved in the dashboard [m]; the planner ignores it
  x: 40.0
  y: 0.0
  z: 2.0
"""

from __future__ import annotations

import contextlib
import math
import os
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from aero_planner.config.drone_config import DroneConfig
from aero_planner.config.planner_config import PlannerConfig
from aero_planner.config.yaml_entries import Entry, parse_entries
from aero_planner.output_files import whole_file
from aero_planner.parameters import ContradictionError, ParameterInfo, SectionedConfig, Value, did_you_mean
from aero_planner.user_file import open_user_file

Config = TypeVar("Config", bound=SectionedConfig)
Drone = TypeVar("Drone", bound=DroneConfig)

ONBOARD = "onboard"
"""Key of the settings of the node."""
GOAL = "goal"
"""Key of the goal."""
PLANNER = "planner"
"""Key of the name of the planner."""

_MAX_BYTES = 2**18


@dataclass(frozen=True)
class ConfigFile:
    """A configuration file that has been parsed, but whose names and values have not been checked."""

    path: str
    entries: tuple[Entry, ...]

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> ConfigFile:
        """Parse a file.

        Raises:
            ValueError: the file can't be read, is not a configuration file, or repeats a key; names file and line.
        """
        return cls(str(path), parse_entries(read_text(path), str(path)))

    @property
    def planner(self) -> str:
        """Name of the planner that is configured; raises ValueError if it is none."""
        for entry in self.entries:
            if entry.key == PLANNER:
                with self._located(entry):
                    return str(_value_of(entry, PLANNER))
        return PlannerConfig.planner

    def planner_config(self, kind: type[Drone] = PlannerConfig) -> Drone:
        """Return the configuration of a planner; entries below `onboard:` and `goal:` are ignored.

        Args:
            kind: class of the configuration.

        Raises:
            ValueError: there is an unknown name or a value out of bounds, names the file, the line and the nearest
                known name; or the file configures another planner.
        """
        base, sections = kind(), []
        if self.planner != kind.planner:
            raise ValueError(
                f"{self.path} configures the planner {self.planner}, not {kind.planner}; add --planner {self.planner}, "
                "or give another file."
            )
        for entry in self.entries:
            if entry.key == "preset":
                with self._located(entry):
                    base = kind.preset(str(_value_of(entry, "preset")))
            elif entry.key not in (ONBOARD, GOAL, PLANNER):
                sections.append(entry)
        return self.change(base, sections)

    def onboard_entries(self) -> tuple[Entry, ...] | None:
        """Return the entries below `onboard:`, or None if the file has no such key; raises ValueError."""
        for entry in self.entries:
            if entry.key == ONBOARD:
                with self._located(entry):
                    if entry.value is not None:
                        raise ValueError(f"put the sections of {ONBOARD!r} on lines below it.")
                return entry.entries
        return None

    def goal(self) -> tuple[float, float, float] | None:
        """Return the goal x, y, z [m], or None if the file has none; raises ValueError unless it is three numbers."""
        for entry in self.entries:
            if entry.key == GOAL:
                with self._located(entry):
                    values = {part.key: part.value for part in entry.entries}
                    if set(values) != {"x", "y", "z"} or not all(_is_coordinate(value) for value in values.values()):
                        raise ValueError("a goal is three finite numbers, on lines 'x:', 'y:' and 'z:' below it.")
                    x, y, z = (float(values[axis] or 0.0) for axis in "xyz")
                    return x, y, z
        return None

    def change(self, config: Config, sections: Sequence[Entry]) -> Config:
        """Return `config` with the values of `sections`; raises ValueError as `planner_config`."""
        changes: dict[str, Value] = {}
        for section in sections:
            with self._located(section):
                config.check_section(section.key)
                if section.value is not None:
                    raise ValueError(
                        f"section {section.key!r} has the value {section.value!r}; put its {config.noun}s on lines "
                        "below it."
                    )
            for entry in section.entries:
                with self._located(entry):
                    path = config.current_path(f"{section.key}.{entry.key}", f"{self.path}, line {entry.line}: ")
                    if path is None:
                        continue
                    info = config.find(path)
                    if path in changes:
                        raise ValueError(f"{path} is given twice, under its old and its new name; remove one.")
                    changes[path] = info.check(_value_of(entry, path, info))
        try:
            return config.replace(changes)
        except ContradictionError as error:
            raise self.locate(error, sections) from None
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from None

    def locate(self, error: ContradictionError, sections: Sequence[Entry]) -> ContradictionError:
        """Return `error` with the file and, if one of `sections` sets one of its parameters, the line in front."""
        lines: dict[str, int] = {}
        for section in sections:
            for entry in section.entries:
                path = f"{section.key}.{entry.key}"
                lines[PlannerConfig.renamed.get(path, path)] = entry.line
        line = next((lines[path] for path in error.paths if path in lines), None)
        where = self.path if line is None else f"{self.path}, line {line}"
        return ContradictionError(f"{where}: {error}", *error.paths, line=line)

    @contextlib.contextmanager
    def _located(self, entry: Entry) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            raise ValueError(f"{self.path}, line {entry.line}: {error}") from None


def load_config(path: str | os.PathLike[str]) -> PlannerConfig:
    """Read the configuration of the planner from a file; settings of the node below `onboard:` are ignored.

    Raises:
        ValueError: the file can't be read, is not a configuration file, or has an unknown or repeated name or a value
            out of bounds; names the file, the line and the nearest known name.
    """
    return ConfigFile.read(path).planner_config()


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a configuration file.

    Raises:
        ValueError: the file can't be read, is not UTF-8, or is larger than 1 MiB.
    """
    try:
        with open_user_file(path) as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise ValueError(f"{path} is larger than 256 KiB; give a configuration file.")
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is not a text file in UTF-8 (byte {error.start}); give a configuration file."
        ) from error
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror or error}.") from error


def config_from_name(name_or_path: str | os.PathLike[str], kind: type[Drone] = PlannerConfig) -> Drone:
    """Return the preset of this name or, if there is none, the configuration in the file of this name.

    Args:
        name_or_path: name of a preset, or path of a file.
        kind: class of the configuration.

    Raises:
        ValueError: there is neither, or the file is wrong; lists the presets.
    """
    name, presets = str(name_or_path), kind.presets()
    if name in presets:
        return kind.preset(name)
    if Path(name).exists():
        return ConfigFile.read(name).planner_config(kind)
    raise ValueError(
        f"{name!r} is neither a preset{did_you_mean(name, presets)} nor a file; presets: {', '.join(presets)}."
    )


def save_config(config: DroneConfig, path: str | os.PathLike[str]) -> None:
    """Write every parameter of `config` to a file, which is replaced as a whole or not at all.

    Raises:
        ValueError: the file can't be written.
    """
    write_text(format_config(config), path)


def write_text(text: str, path: str | os.PathLike[str]) -> None:
    """Write a file, which is replaced as a whole or not at all.

    Raises:
        ValueError: the file can't be written.
    """
    try:
        with whole_file(Path(path).resolve()) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise ValueError(f"{path} can't be written: {error.strerror or error}.") from error


def format_config(config: DroneConfig) -> str:
    """Return the text of a configuration file with every parameter, its help, range and unit."""
    header = "# Configuration of aero-planner. Any line may be left out; the default value then applies."
    return "\n".join([header, *_planner_line(config), *format_sections(config), ""])


def format_changes(config: DroneConfig, *, preset: str = "default") -> str:
    """Return the text of a configuration file with only the differences from a preset."""
    lines = [*_planner_line(config), *([] if preset == "default" else [f"preset: {preset}"])]
    section = ""
    for path in type(config).preset(preset).differences(config):
        info = config.find(path)
        if info.section != section:
            section = info.section
            lines.append(f"{section}:")
        lines.append(f"  {info.name}: {_format_value(info, config.get(path))}")
    return "\n".join([*lines, ""])


def _planner_line(config: DroneConfig) -> list[str]:
    return [] if config.planner == PlannerConfig.planner else [f"{PLANNER}: '{config.planner}'"]


def format_goal(goal: Sequence[float]) -> str:
    """Return the lines of a goal x, y, z [m]."""
    lines = (f"  {axis}: {_number(float(value))}" for axis, value in zip("xyz", goal, strict=True))
    return "\n".join([f"{GOAL}:", *lines, ""])


def format_sections(config: SectionedConfig, indent: str = "") -> list[str]:
    """Return the lines of all sections of a configuration; each parameter is preceded by its help as a comment."""
    lines = []
    for name, section in config.sections().items():
        lines += ["", f"{indent}# {(section.__doc__ or '').splitlines()[0]}", f"{indent}{name}:"]
        for info in section.parameters():
            lines += textwrap.wrap(
                f"{info.help} [{info.range}]", 100, initial_indent=f"{indent}  # ",
                subsequent_indent=f"{indent}  #   ", break_on_hyphens=False,
            )  # fmt: skip
            lines.append(f"{indent}  {info.name}: {_format_value(info, config.get(info.path))}")
    return lines


def _format_value(info: ParameterInfo, value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"'{value}'" if info.form else value  # a text may look like a number or a boolean
    return _number(value)


def _number(value: float) -> str:
    text = repr(value)
    # YAML 1.1 reads 1e-05 as a text: its numbers with an exponent need a point.
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _is_coordinate(value: Value | None) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _value_of(entry: Entry, path: str, info: ParameterInfo | None = None) -> Value:
    if entry.entries:
        raise ValueError(f"{path} has entries below it; write one value after the colon.")
    if entry.value is None:
        if info is not None and info.accepts_nothing:
            return ""
        raise ValueError(f"{path} has no value; write one after the colon or remove the line.")
    return entry.value
