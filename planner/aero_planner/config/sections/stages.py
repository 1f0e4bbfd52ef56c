"""The stages that a planner consists of besides the paper's."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ContradictionError, ParameterSection, did_you_mean, text
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
        known = names("stages")
        listed = {name.strip() for name in self.active.split(",")} - {""}
        for name in sorted(listed):
            if name not in known:
                problem = f"stages.active has {name!r}{did_you_mean(name, known)}; known: {', '.join(known)}."
                raise ContradictionError(problem, "stages.active")
        # In one form, since texts that differ rebuild the planner.
        object.__setattr__(self, "active", ", ".join(name for name in known if name in listed))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the active stages, in the order in which they act."""
        return tuple(self.active.split(", ")) if self.active else ()
