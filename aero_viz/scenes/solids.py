"""Contents of a file of solids: tables of primitives and triangles, as the decoders return them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Table = NDArray[np.float64]

_FACES = ((0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4),
          (1, 5, 7), (1, 7, 3))  # fmt: skip
"""Triangles of a box whose corner 4 i + 2 j + k has the coordinates i, j, k."""


@dataclass
class Solids:
    """Rows of the tables of a `World` [m], [rad]."""

    cylinders: list[Table] = field(default_factory=list)
    boxes: list[Table] = field(default_factory=list)
    spheres: list[Table] = field(default_factory=list)
    triangles: list[Table] = field(default_factory=list)
    ground: Table | None = None
    """Box of the ground, [7]."""
    left_out: dict[str, int] = field(default_factory=dict)
    """Number of parts that a world cannot represent, by kind."""

    def tables(self) -> dict[str, Table]:
        """Return the arguments of `World`; boxes end with the ground."""
        boxes = self.boxes if self.ground is None else [*self.boxes, self.ground]
        columns = {"cylinders": (self.cylinders, 8), "boxes": (boxes, 7), "spheres": (self.spheres, 4),
                   "triangles": (self.triangles, 9)}  # fmt: skip
        return {name: np.reshape(rows, (-1, count)) for name, (rows, count) in columns.items() if rows}

    def add_box(self, pose: Pose, size: Table) -> None:
        """Add a box with its centre at a pose, as triangles where it is tilted by more than a milliradian."""
        yaw = math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
        if pose.is_level:
            self.boxes.append(np.array([*pose.position, *size, yaw]))
            return
        self.triangles += list(box_triangles(pose, size))


@dataclass(frozen=True)
class Pose:
    """A rigid motion x -> rotation x + position."""

    position: Table
    rotation: Table

    @classmethod
    def from_values(cls, values: list[float]) -> Pose:
        """Return the pose of x, y, z [m] and roll, pitch, yaw [rad]: rotations about the fixed axes x, y, z."""
        x, y, z, roll, pitch, yaw = values
        (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
        rotation = np.array([[cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                             [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                             [-sp, cp * sr, cp * cr]])  # fmt: skip
        return cls(np.array([x, y, z]), rotation)

    @property
    def is_level(self) -> bool:
        """True if the z axis points up to within a milliradian."""
        return self.rotation[2, 2] > 1.0 - 5e-7

    def __matmul__(self, child: Pose) -> Pose:
        """Return the pose of a child, which is given in the frame of this pose."""
        return Pose(self.position + self.rotation @ child.position, self.rotation @ child.rotation)


def box_triangles(pose: Pose, size: Table) -> Table:
    """Return the surface of a box [12, 9] with edges `size` [m], [3], and its centre at a pose."""
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)]) * size
    return (pose.position + corners @ pose.rotation.T)[np.array(_FACES)].reshape(-1, 9)
