"""The search: rounds of flights, after each of which the better half of the candidates stays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.batching import Progress, batch_progress, default_batch
from aero_viz.evaluation.tune.search_space import ParameterRange, draw_candidates
from aero_viz.evaluation.tune.tuning_result import Check, Score, TuningResult
from aero_viz.flight import FlightBatch, FlightResult, FlightRules, StateNoise, VehicleModel
from aero_viz.flight.explanation import refuse_impossible
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

__all__ = ["tune"]

_MAX_ROUNDS = 10


def tune(
    config: PlannerConfig,
    ranges: Sequence[ParameterRange],
    worlds: Sequence[World],
    fresh_worlds: Sequence[World],
    *,
    rounds: int = 4,
    seed: int = 0,
    device: str = "cpu",
    batch: int | None = None,
    lidar: LidarModel | None = None,
    vehicle: VehicleModel | None = None,
    rules: FlightRules | None = None,
    noise: StateNoise | None = None,
    progress: Progress | None = None,
) -> TuningResult:
    """Search for better parameter values by flying. Ctrl-C ends the search; the result is the best so far.

    Args:
        config: the incumbent.
        ranges: parameters to tune.
        worlds: worlds of the search, divided evenly among the rounds. To fly in one several times, repeat the object.
        fresh_worlds: worlds of the check.
        rounds: number of rounds. The first one has 2^rounds candidates besides the incumbent, the last one two.
        seed: seed of candidates, LiDARs and planners. Each flight has a different seed, by the order of flying, so that
            batches of any size give the same results.
        device: Warp device.
        batch: largest number of simultaneous flights; None uses `default_batch`.
        lidar: LiDAR model of all drones; None uses the Livox Mid-360.
        vehicle: vehicle of all flights, whatever a candidate assumes; None uses the one that the incumbent assumes.
        rules: when flights end.
        noise: noise of the state estimates; None flies with the true states.
        progress: called as flights finish.

    Raises:
        UserError: a number is out of range, the ranges contradict each other, or no flight can arrive in a world.
        ValueError: an option does not fit the others.
    """
    if not 1 <= rounds <= _MAX_ROUNDS:
        raise UserError(f"The number of rounds is {rounds}; it must be in [1, {_MAX_ROUNDS}].")
    if len(worlds) < rounds:
        raise UserError(f"{len(worlds)} flights are fewer than {rounds} rounds; each round needs at least one.")
    if not fresh_worlds or (batch is not None and batch < 1):
        raise UserError("The number of flights in the check and the batch size must be at least 1.")
    candidates = (config, *draw_candidates(config, ranges, 2**rounds, seed=seed))
    highest_limit = max(candidate.vehicle.speed_limit for candidate in candidates)
    for world in {id(world): world for world in (*worlds, *fresh_worlds)}.values():
        refuse_impossible(world, rules=rules or FlightRules(), speed_limit=highest_limit)

    ends = [len(worlds) * k // rounds for k in range(rounds + 1)]
    per_round = ((end - start) * (2 ** (rounds - k) + 1) for k, (start, end) in enumerate(pairwise(ends)))
    total = sum(per_round) + 2 * len(fresh_worlds)
    flights = _Flights(
        candidates,
        (*worlds, *fresh_worlds),
        size=batch or default_batch(device),
        report=progress or (lambda finished, total, text: None),
        total=total,
        seed=seed,
        device=device,
        lidar=lidar,
        vehicle=vehicle or VehicleModel.from_config(config),
        rules=rules,
        noise=noise,
    )
    search_worlds, check_worlds = range(len(worlds)), range(len(worlds), len(worlds) + len(fresh_worlds))
    remaining, check, interrupted = list(range(len(candidates))), None, False
    try:
        for start, end in pairwise(ends):
            if start:
                remaining = [0, *flights.rank(remaining[1:], range(start))[: len(remaining) // 2]]
            flights.fly([(c, w) for w in range(start, end) for c in remaining], f"{len(remaining) - 1} candidates")
        best = flights.rank(remaining, search_worlds)[0]
        if best:
            flights.fly([(c, w) for w in check_worlds for c in (0, best)], "fresh worlds")
            check = Check.from_results(flights.results_of(0, check_worlds), flights.results_of(best, check_worlds))
    except KeyboardInterrupt:
        interrupted = True
    compared = [w for w in search_worlds if all((c, w) in flights.results for c in remaining)]
    return TuningResult(
        ranges=tuple(ranges),
        candidates=candidates,
        scores=tuple(Score.from_results(flights.results_of(c, search_worlds)) for c in range(len(candidates))),
        best=flights.rank(remaining, compared)[0],
        compared=len(compared),
        check=check,
        interrupted=interrupted,
    )


class _Flights:
    """Flies candidates through worlds and keeps the results.

    Args:
        candidates: configurations of the candidates.
        worlds: all worlds.
        size: largest number of simultaneous flights.
        report: called as flights finish.
        total: number of all flights.
        seed: seed of the first flight.
        options: options of `FlightBatch`.
    """

    def __init__(
        self,
        candidates: Sequence[PlannerConfig],
        worlds: Sequence[World],
        *,
        size: int,
        report: Progress,
        total: int,
        seed: int,
        **options: Any,
    ) -> None:
        self.results: dict[tuple[int, int], FlightResult] = {}
        """Results of the finished flights, by candidate and world."""
        self._candidates, self._worlds, self._options = candidates, worlds, options
        self._size, self._report, self._total, self._seed = size, report, total, seed

    def fly(self, pairs: Sequence[tuple[int, int]], label: str) -> None:
        """Fly pairs of candidate and world.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed. The results of the flights that had finished are kept.
        """
        for first in range(0, len(pairs), self._size):
            part = pairs[first : first + self._size]
            self._report(len(self.results), self._total, label)
            batch = FlightBatch(
                [self._worlds[w] for _, w in part],
                config=[self._candidates[c] for c, _ in part],
                config_names=[str(c) for c, _ in part],
                seed=self._seed,
                **self._options,
            )
            self._seed += len(part)
            progress = batch_progress(self._report, label, before=len(self.results), total=self._total)
            results = batch.run(progress=progress)
            batch.planner.close()
            self.results |= {pair: result for pair, result in zip(part, results, strict=True) if result.reason}
            if batch.interrupted:
                raise KeyboardInterrupt

    def results_of(self, candidate: int, worlds: Iterable[int]) -> list[FlightResult]:
        """Return the results of a candidate's finished flights through these worlds."""
        return [self.results[candidate, w] for w in worlds if (candidate, w) in self.results]

    def rank(self, candidates: Iterable[int], worlds: Sequence[int]) -> list[int]:
        """Return candidates, the best in these worlds first. Of equal ones, such as the incumbent, the first wins."""
        return sorted(candidates, key=lambda c: (Score.from_results(self.results_of(c, worlds)).rank, c))
