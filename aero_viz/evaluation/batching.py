"""Batches of flights: their options, their default size and the report of their progress, for benchmarks and tuning."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from aero_planner.config import DroneConfig, PlannerConfig
from aero_planner.warp_init import find_device
from aero_viz.errors import UserError
from aero_viz.flight import FlightBatch, FlightRules, StateNoise, VehicleModel
from aero_viz.flight.serial import SerialFlights
from aero_viz.planners.registry import is_aero_mppi
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

Progress = Callable[[int, int, str], None]
"""Called with the number of finished flights, the total number, and a description of the current work."""


COUNT_MAX = 100_000
"""Largest number of flights per row, of worlds and of candidates: all are kept in memory."""


def check_count(flag: str, number: int) -> None:
    """Raise a UserError if a flag asks for more flights or candidates than can be kept in memory."""
    if number > COUNT_MAX:
        raise UserError(f"{flag} is {number}; it must be at most {COUNT_MAX}.")


@dataclass(frozen=True)
class FlightOptions:
    """Conditions that all flights of a batch share."""

    device: str = "cpu"
    lidar: LidarModel | None = None
    vehicle: VehicleModel | None = None
    rules: FlightRules | None = None
    noise: StateNoise | None = None

    def build(
        self,
        worlds: Sequence[World],
        configs: Sequence[DroneConfig],
        seeds: Sequence[int],
        *,
        threads: int | None,
        names: Sequence[str] | None = None,
    ) -> FlightBatch | SerialFlights:
        """Return a batch of flights; see `FlightBatch` for the arguments and errors.

        Only AERO-MPPI flies all of them at once; flights of other planners and missions follow one another.
        """
        on_device = [config for config in configs if isinstance(config, PlannerConfig) and is_aero_mppi(config)]
        if len(on_device) == len(configs) and not any(world.mission for world in worlds):
            return FlightBatch(worlds, config=on_device, seed=seeds, config_names=names, threads=threads, **vars(self))
        return SerialFlights(worlds, configs=configs, seeds=seeds, names=names, options=dict(vars(self)))


def batch_status(label: str, finished: int, flights: int, seconds: float) -> str:
    """Return the description of a batch of flights, of which some have finished after a simulated time [s]."""
    return f"{label}: {seconds:.1f} s, {finished} of {flights} finished"


def default_batch(device: str) -> int:
    """Return the default number of simultaneous flights: 256 on a GPU, 1 on a CPU, where batches are not faster.

    Raises:
        UserError: the device is not available.
    """
    try:
        return 256 if find_device(device).is_cuda else 1
    except ValueError as error:
        raise UserError(str(error)) from error
