"""Mesh of a small quadrotor, built from boxes and rings: nose along +x, 0.25 m from the centre to the rotor tips."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.scenes.mesh import Mesh

__all__ = ["quadrotor"]

_ARM = 0.155
_ROTOR = 0.095
_QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_BOX_FACES = np.array([t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))])


def quadrotor() -> dict[str, tuple[Mesh, palette.Rgb, float | None]]:
    """Return the parts by name: a mesh in the body frame [m], a colour, and an opacity (None: opaque)."""
    corners = [(_ARM * np.cos(a), _ARM * np.sin(a)) for a in np.radians((45.0, 135.0, 225.0, 315.0))]
    arms = [_box((0.5 * x, 0.5 * y, 0.0), (_ARM, 0.02, 0.014), np.arctan2(y, x)) for x, y in corners]
    motors = [_box((x, y, 0.014), (0.03, 0.03, 0.036), np.arctan2(y, x)) for x, y in corners]
    rings = [_ring((x, y, 0.034), _ROTOR, 0.009) for x, y in corners]
    discs = [_ring((x, y, 0.034), _ROTOR - 0.009, _ROTOR - 0.011) for x, y in corners]
    body = [_box((0.0, 0.0, 0.004), (0.15, 0.075, 0.04), 0.0), _box((-0.01, 0.0, 0.034), (0.08, 0.055, 0.022), 0.0)]
    lidar = [_box((0.03, 0.0, 0.052), (0.042, 0.042, 0.034), np.pi / 4.0)]
    return {
        "body": (_joined(body), palette.DRONE, None),
        "arms": (_joined(arms + motors + lidar), palette.DRONE_DARK, None),
        "rotor_rings": (_joined(rings[1:3]), palette.DRONE, None),
        "nose": (
            _joined([*rings[:1], *rings[3:], _box((0.083, 0.0, 0.004), (0.018, 0.05, 0.026), 0.0)]),
            palette.TRAIL,
            None,
        ),
        "discs": (_joined(discs), palette.ROTOR, 0.25),
    }


def _box(center: tuple[float, float, float], size: tuple[float, float, float], yaw: float) -> Mesh:
    corner = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
    c, s = np.cos(yaw), np.sin(yaw)
    rotated = corner @ np.array([(c, s, 0.0), (-s, c, 0.0), (0.0, 0.0, 1.0)])
    return Mesh((rotated + center).astype(np.float32), _BOX_FACES.astype(np.int32))


def _ring(center: tuple[float, float, float], radius: float, width: float, sides: int = 32) -> Mesh:
    """Return a flat ring in the xy plane; a disc if the width equals the radius."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    rim: NDArray[np.float64] = np.stack((np.cos(angle), np.sin(angle), np.zeros(sides)), axis=1)
    j, k = np.arange(sides), (np.arange(sides) + 1) % sides
    faces = np.concatenate((np.stack((j, k, k + sides), axis=1), np.stack((j, k + sides, j + sides), axis=1)))
    return Mesh(
        (np.concatenate(((radius - width) * rim, radius * rim)) + center).astype(np.float32), faces.astype(np.int32)
    )


def _joined(parts: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=True)])
    return Mesh(np.concatenate([part.vertices for part in parts]), faces.astype(np.int32))
