"""Flags of renamed planner parameters, which keep their old spelling for one release."""

from __future__ import annotations

from collections.abc import Sequence

from aero_planner.config import PlannerConfig


def replace_renamed_flags(arguments: Sequence[str]) -> list[str]:
    """Return command-line arguments in which flags of renamed planner parameters have their current names.

    A notice is logged for each of them. Flags of removed parameters are left out with their values.
    """
    if any(argument.startswith("--planner") for argument in arguments):
        return list(arguments)  # names of another planner's parameters
    result: list[str] = []
    remaining = iter(arguments)
    for argument in remaining:
        flag, equals, value = argument.partition("=")
        path = flag.removeprefix("--").replace("-", "_")
        if not flag.startswith("--") or (path not in PlannerConfig.renamed and path not in PlannerConfig.removed):
            result.append(argument)
            continue
        current = PlannerConfig.current_path(path)
        if current is not None:
            result.append(f"--{current.replace('_', '-')}{equals}{value}")
        elif not equals:
            next(remaining, None)
    return result
