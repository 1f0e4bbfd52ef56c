"""The search: rounds of flights, after each of which the better half stays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.evaluation.bench.runner import Progress, default_batch
from aero_viz.evaluation.tune.outcome import Check, Score, Tuning
from aero_viz.evaluation.tune.spans import Span, draw
from aero_viz.flight import FlightBatch, FlightResult, FlightRules, StateNoise, VehicleModel
from aero_viz.flight.explanation import refuse_impossible
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

__all__ = ["tune"]

_ROUNDS_MAX = 10


def tune(
    config: PlannerConfig,
    spans: Sequence[Span],
    worlds: Sequence[World],
    fresh: Sequence[World],
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
) -> Tuning:
    """Find better values by flying; Ctrl-C ends it with what is known so far.

    Args:
        config: the incumbent.
        spans: what to try.
        worlds: of the search, dealt out evenly over the rounds; repeat a World object to fly it several times.
        fresh: worlds of the check.
        rounds: the first has 2^rounds candidates beside the incumbent, the last two.
        seed: of candidates, LiDARs and planners. Each flight has a seed of its own, in the order of flying: batches of
            any size give the same results.
        device: Warp device.
        batch: flights at once at most; None is `default_batch`.
        lidar: of all drones; None is the Livox Mid-360.
        vehicle: of all drones, whatever a candidate believes; None is the one that the incumbent assumes.
        rules: when flights end.
        noise: of the state estimates; None for the true states.
        progress: told how it goes.

    Raises:
        UserError: a number is out of range, hardly any values fit each other, or no flight can arrive in a world.
        ValueError: an option does not fit the others.
    """
    if not 1 <= rounds <= _ROUNDS_MAX:
        raise UserError(f"The number of rounds is {rounds}; it must be in [1, {_ROUNDS_MAX}].")
    if len(worlds) < rounds:
        raise UserError(f"{len(worlds)} flights are fewer than {rounds} rounds; each round needs a world more.")
    if not fresh or (batch is not None and batch < 1):
        raise UserError("The numbers of flights in the check and in a batch must be at least 1.")
    candidates = (config, *draw(config, spans, 2**rounds, seed=seed))
    fastest = max(one.vehicle.speed_limit for one in candidates)
    for world in {id(world): world for world in (*worlds, *fresh)}.values():
        refuse_impossible(world, rules=rules or FlightRules(), speed_limit=fastest)

    ends = [len(worlds) * k // rounds for k in range(rounds + 1)]
    flown = ((end - start) * (2 ** (rounds - k) + 1) for k, (start, end) in enumerate(pairwise(ends)))
    total = sum(flown) + 2 * len(fresh)
    flights = _Flights(
        candidates,
        (*worlds, *fresh),
        size=batch or default_batch(device),
        tell=lambda over, text: progress and progress(over, total, text),
        seed=seed,
        device=device,
        lidar=lidar,
        vehicle=vehicle or VehicleModel.from_config(config),
        rules=rules,
        noise=noise,
    )
    searched, later = range(len(worlds)), range(len(worlds), len(worlds) + len(fresh))
    left, check, interrupted = list(range(len(candidates))), None, False
    try:
        for start, end in pairwise(ends):
            if start:
                left = [0, *flights.ranked(left[1:], range(start))[: len(left) // 2]]
            flights.fly([(c, w) for w in range(start, end) for c in left], f"{len(left) - 1} candidates")
        best = flights.ranked(left, searched)[0]
        if best:
            flights.fly([(c, w) for w in later for c in (0, best)], "fresh worlds")
            check = Check.of(flights.of(0, later), flights.of(best, later))
    except KeyboardInterrupt:
        interrupted = True
    compared = [w for w in searched if all((c, w) in flights.over for c in left)]
    return Tuning(
        spans=tuple(spans),
        candidates=candidates,
        scores=tuple(Score.of(flights.of(c, searched)) for c in range(len(candidates))),
        best=flights.ranked(left, compared)[0],
        compared=len(compared),
        check=check,
        interrupted=interrupted,
    )


class _Flights:
    """Flies candidates through worlds, and keeps how each flight ended.

    Args:
        candidates: their configurations.
        worlds: all.
        size: flights at once at most.
        tell: takes the number of flights that are over, and what is going on.
        seed: of the first flight.
        options: of `FlightBatch`.
    """

    def __init__(
        self,
        candidates: Sequence[PlannerConfig],
        worlds: Sequence[World],
        *,
        size: int,
        tell: Callable[[int, str], Any],
        seed: int,
        **options: Any,
    ) -> None:
        self.over: dict[tuple[int, int], FlightResult] = {}
        self._candidates, self._worlds, self._options = candidates, worlds, options
        self._size, self._tell, self._seed = size, tell, seed

    def fly(self, pairs: Sequence[tuple[int, int]], label: str) -> None:
        """Fly pairs of candidate and world; Ctrl-C raises KeyboardInterrupt, with the flights kept that were over."""
        for first in range(0, len(pairs), self._size):
            part = pairs[first : first + self._size]
            self._tell(len(self.over), label)
            batch = FlightBatch(
                [self._worlds[w] for _, w in part],
                config=[self._candidates[c] for c, _ in part],
                config_names=[str(c) for c, _ in part],
                seed=self._seed,
                **self._options,
            )
            self._seed += len(part)
            results = batch.run(progress=partial(self._tell_batch, label, len(self.over)))
            batch.planner.close()
            self.over |= {pair: one for pair, one in zip(part, results, strict=True) if one.reason is not None}
            if batch.interrupted:
                raise KeyboardInterrupt

    def of(self, candidate: int, worlds: Iterable[int]) -> list[FlightResult]:
        """Return how a candidate's flights through these worlds ended, as far as they are over."""
        return [self.over[candidate, w] for w in worlds if (candidate, w) in self.over]

    def ranked(self, candidates: Iterable[int], worlds: Sequence[int]) -> list[int]:
        """Return candidates, the best in these worlds first; of equals the first, such as the incumbent."""
        return sorted(candidates, key=lambda c: (Score.of(self.of(c, worlds)).rank, c))

    def _tell_batch(self, label: str, before: int, finished: int, flights: int, seconds: float) -> None:
        self._tell(before + finished, f"{label}: {seconds:.1f} s, {finished} of {flights} over")
