"""Flights of two configurations through the worlds of the same seeds, with intervals and a paired test."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from aero_planner.config import DroneConfig
from aero_viz.session import Session
from aero_viz.session.source import Source
from aero_viz.statistics import PairedSeeds, SeedFlight


def fly_seeds(
    open_seed: Callable[[int], Source],
    seeds: Sequence[int],
    a: Callable[[Source], DroneConfig],
    b: Callable[[Source], DroneConfig],
    *,
    device: str,
    goes_on: Callable[[], bool],
) -> Iterator[PairedSeeds]:
    """Fly A and then B through the world of each seed, and yield the flights after each pair.

    Args:
        open_seed: opens the flight of a seed; every call opens it anew.
        seeds: the seeds.
        a, b: return the configurations for a flight.
        device: Warp device of the planners.
        goes_on: asked before every tick; False ends the flights, without the pair that is not complete.
    """
    flown_a: list[SeedFlight] = []
    flown_b: list[SeedFlight] = []
    for number, seed in enumerate(seeds, 1):
        for flown, config in ((flown_a, a), (flown_b, b)):
            flight = _fly(open_seed(seed), seed, config, device, goes_on)
            if flight is None:
                return
            flown.append(flight)
        yield PairedSeeds(tuple(seeds[:number]), tuple(flown_a), tuple(flown_b))


def _fly(
    source: Source, seed: int, config: Callable[[Source], DroneConfig], device: str, goes_on: Callable[[], bool]
) -> SeedFlight | None:
    """Fly to the end; return None if `goes_on` has stopped it."""
    session = Session(source, config=config(source), device=device, seed=seed)
    try:
        while goes_on():
            frame = session.tick()
            if frame.outcome is not None:
                return SeedFlight(frame.outcome, frame.time)
        return None
    finally:
        session.close()
