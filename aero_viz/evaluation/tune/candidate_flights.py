"""The flights of candidates through worlds, in batches that an executor flies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from aero_planner.config import DroneConfig
from aero_viz.evaluation.batching import FlightOptions, Progress, batch_status
from aero_viz.evaluation.executor import Executor
from aero_viz.flight import FlightResult
from aero_viz.flight.batch import BatchProgress
from aero_viz.scenes import World


@dataclass(frozen=True)
class _Shard:
    """One batch of flights."""

    worlds: tuple[World, ...]
    configs: tuple[DroneConfig, ...]
    seeds: tuple[int, ...]
    options: FlightOptions
    threads: int | None


class CandidateFlights:
    """Flies candidates through worlds.

    Every candidate has the same seed in the same world, so that candidates do not differ in the LiDAR, the noise and
    the samples of the planner.

    Args:
        worlds: all worlds. A world that occurs several times is flown with different seeds.
        seed: seed of the first world; that of the next one is larger by one, and so on.
        options: options of all flights.
        executor: flies the batches.
        size: largest number of simultaneous flights.
        report: called as flights finish.

    Attributes:
        done: number of finished flights.
        total: number of all flights that are expected.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        *,
        seed: int,
        options: FlightOptions,
        executor: Executor,
        size: int,
        report: Progress,
    ) -> None:
        self._worlds, self._seed, self._options = worlds, seed, options
        self._executor, self._size, self._report = executor, size, report
        self.done = self.total = 0
        self._is_interrupted = False

    def fly(
        self, configs: Sequence[DroneConfig], worlds: Sequence[int], label: str
    ) -> dict[tuple[int, int], FlightResult]:
        """Fly each configuration through each of these worlds; return the results by index of both.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed, now or during the last flights before, which were complete.
        """
        if self._is_interrupted:
            raise KeyboardInterrupt
        pairs = [(c, w) for w in worlds for c in range(len(configs))]
        parts = [pairs[first : first + self._size] for first in range(0, len(pairs), self._size)]
        shards = [
            _Shard(
                tuple(self._worlds[w] for _, w in part),
                tuple(configs[c] for c, _ in part),
                tuple(self._seed + w for _, w in part),
                self._options,
                self._executor.threads,
            )
            for part in parts
        ]
        results: dict[tuple[int, int], FlightResult] = {}
        self._report(self.done, self.total, label)

        def follow(finished: int, flights: int, seconds: float) -> None:
            self._report(self.done + finished, self.total, batch_status(label, finished, flights, seconds))

        for index, (flown, interrupted) in self._executor.map(_fly_shard, shards, progress=follow):
            self._is_interrupted |= interrupted
            if interrupted and (len(flown) + len(results) < len(pairs) or not all(flight.reason for flight in flown)):
                raise KeyboardInterrupt
            results.update(zip(parts[index], flown, strict=True))
            self.done += len(flown)
            self._report(self.done, self.total, label)
        return results


def _fly_shard(shard: _Shard, progress: BatchProgress | None) -> tuple[list[FlightResult], bool]:
    """Fly one batch; return the results, and whether Ctrl-C interrupted it."""
    batch = shard.options.build(shard.worlds, shard.configs, shard.seeds, threads=shard.threads)
    results = batch.run(progress=progress)
    batch.close()
    return results, batch.interrupted
