"""Mesh of a small quadrotor, built from boxes and rings: nose along +x, 0.25 m from the centre to the rotor tips."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.scenes.mesh import Mesh, box_mesh, joined_mesh

_ARM = 0.155
_ROTOR = 0.095


def quadrotor() -> dict[str, tuple[Mesh, palette.Rgb, float | None]]:
    """Return the parts by name: a mesh in the body frame [m], a colour, and an opacity (None: opaque)."""
    corners = [(_ARM * np.cos(a), _ARM * np.sin(a)) for a in np.radians((45.0, 135.0, 225.0, 315.0))]
    arms = [(0.5 * x, 0.5 * y, 0.0, _ARM, 0.02, 0.014, np.arctan2(y, x)) for x, y in corners]
    motors = [(x, y, 0.014, 0.03, 0.03, 0.036, np.arctan2(y, x)) for x, y in corners]
    rings = [_ring((x, y, 0.034), _ROTOR, 0.009) for x, y in corners]
    discs = [_ring((x, y, 0.034), _ROTOR - 0.009, _ROTOR - 0.011) for x, y in corners]
    body = [(0.0, 0.0, 0.004, 0.15, 0.075, 0.04, 0.0), (-0.01, 0.0, 0.034, 0.08, 0.055, 0.022, 0.0)]
    lidar = (0.03, 0.0, 0.052, 0.042, 0.042, 0.034, np.pi / 4.0)
    nose = box_mesh(np.array([(0.083, 0.0, 0.004, 0.018, 0.05, 0.026, 0.0)]))
    return {
        "body": (box_mesh(np.array(body)), palette.DRONE, None),
        "arms": (box_mesh(np.array([*arms, *motors, lidar])), palette.DRONE_DARK, None),
        "rotor_rings": (joined_mesh(rings[1:3]), palette.DRONE_DARK, None),
        "nose": (joined_mesh([*rings[:1], *rings[3:], nose]), palette.NOSE, None),
        "discs": (joined_mesh(discs), palette.ROTOR, 0.25),
    }


def _ring(center: tuple[float, float, float], radius: float, width: float, sides: int = 32) -> Mesh:
    """Return a flat ring in the xy plane; a disc if the width equals the radius."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    rim: NDArray[np.float64] = np.stack((np.cos(angle), np.sin(angle), np.zeros(sides)), axis=1)
    j, k = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = np.concatenate((np.stack((j, k, k + sides), axis=1), np.stack((j, k + sides, j + sides), axis=1)))
    return Mesh(
        (np.concatenate(((radius - width) * rim, radius * rim)) + center).astype(np.float32), faces.astype(np.int32)
    )
