"""Flights of any planner, one after another, with the interface of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from aero_planner.config import DroneConfig
from aero_viz.flight.batch import BatchProgress
from aero_viz.flight.interrupt import FlightInterrupted
from aero_viz.flight.metrics import FlightResult
from aero_viz.flight.single import fly
from aero_viz.scenes.world import World


class SerialFlights:
    """Flights that share no launch: for planners that are not on the device.

    Args:
        worlds: one per flight.
        configs: one per flight.
        seeds: one per flight.
        names: names of the configurations in the results; None is that of an equal preset.
        options: arguments of `fly` that all flights share.

    Attributes:
        interrupted: True if Ctrl-C was pressed during the last `run`.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        *,
        configs: Sequence[DroneConfig],
        seeds: Sequence[int],
        names: Sequence[str] | None = None,
        options: dict[str, Any],
    ) -> None:
        self._flights = list(zip(worlds, configs, seeds, names or [None] * len(worlds), strict=True))
        self._options = options
        self.interrupted = False

    def run(self, *, progress: BatchProgress | None = None) -> list[FlightResult]:
        """Fly, or until Ctrl-C; the flights so far are returned, of which the last one may have the reason None.

        Args:
            progress: called after every plan with the number of finished flights.
        """
        results: list[FlightResult] = []
        for world, config, seed, name in self._flights:
            follow = None if progress is None else _follow(progress, len(results), len(self._flights))
            options = {"config": config, "seed": seed, "config_name": name, "progress": follow, **self._options}
            try:
                results.append(fly(world, **options))
            except FlightInterrupted as interruption:
                results.append(interruption.result)
                self.interrupted = True
                break
        return results

    def close(self) -> None:
        """Do nothing: every flight has closed its planner."""


def _follow(progress: BatchProgress, finished: int, total: int) -> Any:
    return lambda share, time: progress(finished, total, time)
