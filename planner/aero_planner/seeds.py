"""Seeds of batches."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import SupportsIndex

Seeds = SupportsIndex | Sequence[SupportsIndex]
"""One seed for a batch, or one for each drone; whole numbers of Python or NumPy."""


def seeds_of_batch(seed: Seeds, count: int) -> list[int]:
    """Return the seeds of `count` drones: from `seed` on, or the given ones.

    Raises:
        ValueError: a seed is not a whole number.
    """
    try:
        first = operator.index(seed)  # pyright: ignore[reportArgumentType]
    except TypeError:
        try:
            return [operator.index(number) for number in seed]  # pyright: ignore[reportGeneralTypeIssues]
        except TypeError:
            raise ValueError(f"seed is {seed!r}; it must be a whole number, or one for each drone.") from None
    return [first + b for b in range(count)]
