"""The stages that a planner consists of besides the paper's."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, names_list
from aero_planner.registry import names


@dataclass(frozen=True)
class StageConfig(ParameterSection, section="stages"):
    """Stages: what the planner has besides the paper."""

    active: str = names_list(
        ", ".join(names("stages")), names("stages"),
        "Stages that are compiled in; empty as in the paper. A stage that is not listed costs nothing. Each stage can "
        "also be switched by a parameter of its own, without a new compilation.",
        label="Active stages",
    )  # fmt: skip

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the active stages, in the order in which they act."""
        return tuple(self.active.split(", ")) if self.active else ()
