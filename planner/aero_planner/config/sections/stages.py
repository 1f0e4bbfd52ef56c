"""The stages that a planner consists of besides the paper's."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, did_you_mean, text
from aero_planner.registry import names


@dataclass(frozen=True)
class StageConfig(ParameterSection, section="stages"):
    """Stages: what the planner has besides the paper."""

    active: str = text(
        ", ".join(names("stages")), r"(\w+(\s*,\s*\w+)*)?", "names separated by commas",
        "Stages that are compiled in; empty as in the paper. A stage that is not listed costs nothing. Each stage can "
        "also be switched by a parameter of its own, without a new compilation.",
        label="Active stages",
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.names:
            if name not in names("stages"):
                hint = did_you_mean(name, names("stages"))
                raise ValueError(f"stages.active has {name!r}{hint}; known: {', '.join(names('stages'))}.")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the active stages, in the order in which they act."""
        listed = {name.strip() for name in self.active.split(",")} - {""}
        return tuple(dict.fromkeys([name for name in names("stages") if name in listed] + sorted(listed)))
