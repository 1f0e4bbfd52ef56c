"""Progress of a flight as the share of the distance to the goal."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from aero_viz.scenes.world import World

__all__ = ["distance_share"]


def distance_share(world: World, position: ArrayLike) -> float:
    """Return the share of the distance from start to goal that a drone at `position` [m], [3], has covered, 0 to 1."""
    whole = float(np.linalg.norm(world.goal - world.start))
    left = float(np.linalg.norm(world.goal - np.asarray(position, dtype=np.float64)))
    return max(0.0, 1.0 - left / whole) if whole > 0.0 else 1.0
