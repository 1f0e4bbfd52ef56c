"""The state that the planner carries from one plan to the next, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.array_memory import array_specs


@dataclass(frozen=True, eq=False)
class History:
    """State that the planner carries from one plan to the next: copies of all arrays that are declared as such.

    Attributes:
        arrays: each array by its name, such as "previous_controls", with a leading axis B; see `aero_planner.arrays`
            and the stages.
    """

    arrays: dict[str, NDArray[Any]]

    @classmethod
    def of(cls, groups: Iterable[Any]) -> History:
        """Return copies of the arrays that are kept for later plans, of all dataclasses of arrays."""
        return cls({name: np.array(array.numpy()) for name, array in kept_arrays(groups).items()})

    def write_to(self, groups: Iterable[Any]) -> bool:
        """Copy the history to the arrays; return False, without a change, if they differ in names or shapes."""
        kept = kept_arrays(groups)
        shapes = {name: array.numpy().shape for name, array in kept.items()}
        if shapes != {name: values.shape for name, values in self.arrays.items()}:
            return False
        for name, array in kept.items():
            array.assign(self.arrays[name])
        return True


def kept_arrays(groups: Iterable[Any]) -> dict[str, wp.array]:
    """Return the arrays that are kept for later plans, of dataclasses of arrays, by name."""
    return {
        name: getattr(group, name)
        for group in groups
        for name, spec in array_specs(type(group)).items()
        if spec.kept == "plans"
    }


def format_initial_state(kinds: Iterable[type]) -> str:
    """Return a line of name, type and initial value for each array that is kept for later plans.

    Args:
        kinds: dataclasses that declare arrays.
    """
    kept = ((name, spec) for kind in kinds for name, spec in array_specs(kind).items() if spec.kept == "plans")
    return "".join(f"{name} {spec.item.base} {spec.initial!r}\n" for name, spec in kept)
