"""The seeds that all commands accept."""

from __future__ import annotations

from aero_viz.errors import UserError


def check_seed(seed: int) -> None:
    """Raise a UserError unless a seed is in the range of all random generators of a run, that of Optuna included."""
    if not 0 <= seed < 2**32:
        raise UserError(f"--seed is {seed}; it must be in [0, 2^32 - 1].")
