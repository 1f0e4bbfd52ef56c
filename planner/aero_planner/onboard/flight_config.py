"""Configurations of planner and node that were checked together; errors name the file and the line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from aero_planner.config import PlannerConfig
from aero_planner.config.file import ConfigFile
from aero_planner.config.yaml_entries import Entry
from aero_planner.onboard.settings import (
    OnboardConfig,
    check_together,
    flight_config_from_name,
    load_any,
    load_onboard,
)
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
