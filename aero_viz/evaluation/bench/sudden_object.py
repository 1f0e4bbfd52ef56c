"""An object that suddenly appears in front of a drone: the test of IPC (Liu, Ren and Zhang, RA-L 2023)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aero_planner.config import VehicleConfig
from aero_viz.errors import UserError
from aero_viz.flight import FlightBatch, FlightRules
from aero_viz.scenes import World

SIZE = (0.2, 0.2, 3.0)
"""Edge lengths of the object [m]. It stands on the ground."""
_HEIGHT = 1.0  # of start and goal above the ground [m]
_OFFSET_MAX = 0.1  # largest lateral distance of the object from the drone [m]: the drone's centre would always hit it
_DIRECTIONS = np.radians(np.linspace(0.0, 90.0, 31))
_STEP = 0.002  # [s]
_REACTION = 3.0  # [s]; longer than any stop from 10 m/s


@dataclass(frozen=True)
class SuddenObject:
    """An object that appears in front of a drone in flight."""

    run_up: float
    """Distance from the start at which it appears, by which the drone has reached its speed [m]."""
    distance: float
    """Horizontal distance from the centre of the drone to the front of the object when it appears [m]."""

    def added_to(self, world: World, position: np.ndarray, *, offset: float) -> World:
        """Return the world with the object in front of a drone at `position` [m], [3], and `offset` [m] to its left."""
        x, y = position[0] + self.distance + 0.5 * SIZE[0], position[1] + offset
        box = (x, y, 0.5 * SIZE[2], *SIZE, 0.0)
        return dataclasses.replace(world, boxes=np.vstack([world.boxes, box]))


def open_field(speed: float) -> tuple[World, float]:
    """Return a world of flat ground, with start and goal on a line along x, and its run-up for this speed [m]."""
    run_up = 1.0 + 1.2 * speed
    goal = run_up + 5.0 + speed
    ground = np.array([[0.5 * goal, 0.0, -0.5, goal + 60.0, 60.0, 1.0, 0.0]])
    start, end = np.array([0.0, 0.0, _HEIGHT]), np.array([goal, 0.0, _HEIGHT])
    return World("open-field", start, end, boxes=ground), run_up


def check_arrival(label: str, sudden: SuddenObject, world: World, rules: FlightRules) -> None:
    """Refuse rules under which a drone can arrive before it has passed the object of the row `label`.

    Raises:
        UserError: the arrival radius is too large.
    """
    behind = sudden.run_up + sudden.distance + SIZE[0] + rules.radius
    largest = float(np.linalg.norm(world.goal - world.start)) - behind
    if rules.arrival_radius > largest:
        raise UserError(
            f"The row {label!r} cannot be flown: rules.arrival_radius is {rules.arrival_radius:g} m, and a drone would "
            f"arrive before it has passed the object; give at most {largest:.2f} m."
        )


class SuddenObjects:
    """Adds an object to each flight of a batch at the tick at which it is due to appear.

    Args:
        batch: flights that have not begun.
        worlds: their worlds.
        objects: one per flight; None adds nothing.
        seeds: one per flight, of the lateral offset of the object.

    Attributes:
        speeds: speed of each drone when its object appeared [m/s], [B]; None if it did not.
    """

    def __init__(
        self,
        batch: FlightBatch,
        worlds: Sequence[World],
        objects: Sequence[SuddenObject | None],
        seeds: Sequence[int],
    ) -> None:
        self.speeds: list[float | None] = [None] * len(worlds)
        self._batch, self._worlds, self._objects = batch, list(worlds), objects
        self._offsets = [float(np.random.default_rng(seed).uniform(-_OFFSET_MAX, _OFFSET_MAX)) for seed in seeds]
        if any(objects):
            batch.simulator.observers.append(self._add_due)

    def _add_due(self) -> None:
        vehicle = self._batch.simulator.vehicle
        positions = vehicle.position.numpy()
        due = [
            b
            for b, sudden in enumerate(self._objects)
            if sudden is not None
            and self.speeds[b] is None
            and positions[b, 0] >= self._worlds[b].start[0] + sudden.run_up
        ]
        if not due:
            return
        velocities = vehicle.velocity.numpy()
        for b in due:
            sudden = self._objects[b]
            assert sudden is not None
            position = positions[b].astype(np.float64)
            self._worlds[b] = sudden.added_to(self._worlds[b], position, offset=self._offsets[b])
            self.speeds[b] = float(np.linalg.norm(velocities[b]))
        self._batch.set_worlds(self._worlds)


def can_evade(distance: float, speed: float, *, vehicle: VehicleConfig, radius: float) -> bool:
    """Return whether a drone in straight and level flight could evade the object if it saw it at once.

    The drone tilts from level at its full rate, up to the tilt at which its full thrust holds the height, in the best
    of all directions between straight back and sideways. It must stop, or pass the object on the nearer side. The
    object has the largest lateral offset of any seed.

    Args:
        distance: from the centre of the drone to the front of the object [m].
        speed: towards the object [m/s].
        vehicle: mass, thrust and body rates.
        radius: radius of the drone [m].
    """
    edge = 0.5 * SIZE[1] - _OFFSET_MAX
    times = np.arange(0.0, _REACTION, _STEP)
    tilt_max = math.acos(min(1.0, vehicle.mass * vehicle.gravity / vehicle.thrust_max))
    tilt = np.minimum(vehicle.rate_xy_max * times, tilt_max)
    change = np.cumsum(vehicle.thrust_max / vehicle.mass * np.sin(tilt)) * _STEP
    """Change of the velocity along the direction of the acceleration [m/s]."""
    for direction in _DIRECTIONS:
        forward = np.maximum(speed - math.cos(direction) * change, 0.0).cumsum() * _STEP
        sideways = (math.sin(direction) * change).cumsum() * _STEP
        ahead = distance - forward  # negative next to and behind the object
        gap_x = np.maximum(np.maximum(ahead, -ahead - SIZE[0]), 0.0)
        gap_y = np.maximum(sideways - edge, 0.0)
        if np.hypot(gap_x, gap_y).min() > radius:
            return True
    return False
