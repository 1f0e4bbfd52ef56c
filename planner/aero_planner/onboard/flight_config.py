"""Files with the configurations of planner and node. Errors name the file and the line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from aero_planner.config import PlannerConfig
from aero_planner.config.file import ONBOARD, ConfigFile, config_from_name, format_sections
from aero_planner.config.yaml_entries import Entry
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.parameters import ContradictionError

FlightConfig = tuple[PlannerConfig, OnboardConfig]


def load_checked(config: str | os.PathLike[str], onboard_file: str | os.PathLike[str] | None = None) -> FlightConfig:
    """Return the configurations of planner and node with which to fly.

    Args:
        config: preset, or file that may hold both.
        onboard_file: file with the settings of the node, which replace those in `config`.

    Raises:
        ValueError: as `flight_config_from_name` and `load_onboard`, or the two contradict each other.
    """
    planner, onboard = flight_config_from_name(config)
    if onboard_file is not None:
        onboard = load_onboard(onboard_file)
    return _check((planner, onboard), config, onboard_file)


def load_any_checked(config: str | os.PathLike[str]) -> FlightConfig:
    """Return the configurations of a preset, or of a file for planner, node, or both; raises as `load_checked`."""
    return load_checked(config) if str(config) in PlannerConfig.presets() else _check(load_any(config), config, None)


def _check(
    configs: FlightConfig, config: str | os.PathLike[str], onboard_file: str | os.PathLike[str] | None
) -> FlightConfig:
    try:
        check_together(*configs)
    except ContradictionError as error:
        located = error
        for file, sections in _files(config, onboard_file):
            located = file.locate(error, sections)
            if located.line is not None:
                break
        raise located from None
    return configs


def _files(
    config: str | os.PathLike[str], onboard_file: str | os.PathLike[str] | None
) -> Iterator[tuple[ConfigFile, list[Entry]]]:
    """Yield each configuration file with those of its sections that are in force."""
    if str(config) not in PlannerConfig.presets() and Path(config).exists():
        file = ConfigFile.read(config)
        sections = list(file.entries)
        if onboard_file is None:
            sections += file.onboard_entries() or ()
        yield file, sections
    if onboard_file is not None:
        file = ConfigFile.read(onboard_file)
        yield file, [*file.entries, *(file.onboard_entries() or ())]


def load_flight_config(path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Read the configuration of the planner and, from below `onboard:`, that of the node; the rest is the default.

    Raises:
        ValueError: as `aero_planner.config.file.load_config`.
    """
    file = ConfigFile.read(path)
    return file.planner_config(), file.change(OnboardConfig(), file.onboard_entries() or ())


def flight_config_from_name(name_or_path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Return a preset with the default settings of the node or, if there is none of this name, the content of a file.

    Raises:
        ValueError: there is neither, or the file is wrong; lists the presets.
    """
    if str(name_or_path) not in PlannerConfig.presets() and Path(name_or_path).exists():
        return load_flight_config(name_or_path)
    return config_from_name(name_or_path), OnboardConfig()


def load_onboard(path: str | os.PathLike[str]) -> OnboardConfig:
    """Read the configuration of the node from a file without planner parameters.

    The sections may stand below `onboard:` or, without this line, at the top level.

    Raises:
        ValueError: as `load_flight_config`, or the file has planner parameters.
    """
    file = ConfigFile.read(path)
    sections = file.onboard_entries()
    if sections is None:
        return file.change(OnboardConfig(), file.entries)
    for entry in file.entries:
        if entry.key != ONBOARD:
            raise ValueError(
                f"{path}, line {entry.line}: {entry.key!r} is not one of the node's settings, which belong below "
                f"'{ONBOARD}:'; give a file with both as --config."
            )
    return file.change(OnboardConfig(), sections)


def load_any(path: str | os.PathLike[str]) -> tuple[PlannerConfig, OnboardConfig]:
    """Read a file with planner parameters, settings of the node, or both; raises ValueError as the functions above."""
    entries = ConfigFile.read(path).entries
    if entries and entries[0].key in OnboardConfig.sections():
        return PlannerConfig(), load_onboard(path)
    return load_flight_config(path)


def format_onboard(config: OnboardConfig) -> str:
    """Return the `onboard:` part of a configuration file: every setting with its help, range and unit."""
    return "\n".join([f"{ONBOARD}:", *format_sections(config, "  "), ""])
