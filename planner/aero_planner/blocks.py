"""Reductions over the threads of a block, which on a CPU are one."""

from __future__ import annotations

import warp as wp

__all__ = ["least_of_block", "sum_of_block"]

wp.set_module_options({"enable_backward": False})


@wp.func
def only(x: float) -> float:
    """What a block of one thread has."""
    return x


@wp.func
def tile_least(x: float) -> float:
    """The least that any thread of the block has."""
    return wp.tile_extract(wp.tile_min(wp.tile(x)), 0)


@wp.func
def tile_total(x: float) -> float:
    """The sum of what the threads of the block have."""
    return wp.tile_extract(wp.tile_sum(wp.tile(x)), 0)


# Not tiles of one on a CPU: they share memory between the threads that launch.


def least_of_block(threads: int) -> wp.Function:
    """Return the function that gives every thread of a block the least value of all."""
    return only if threads == 1 else tile_least


def sum_of_block(threads: int) -> wp.Function:
    """Return the function that gives every thread of a block the sum of all values."""
    return only if threads == 1 else tile_total
