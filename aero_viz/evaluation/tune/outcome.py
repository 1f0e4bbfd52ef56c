"""What came of a search: scores, the check in fresh worlds, and what to think of both."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from aero_planner import PlannerConfig
from aero_viz.evaluation.statistics import wilson
from aero_viz.evaluation.tune.spans import Span
from aero_viz.flight import FlightResult

__all__ = ["Check", "Score", "Tuning"]

_CHANCE = 0.05


@dataclass(frozen=True)
class Score:
    """How a candidate's flights ended."""

    flights: int
    arrived: int
    flight_time_s: float | None
    """Mean of those that arrived; None where none did."""

    @classmethod
    def of(cls, results: Iterable[FlightResult]) -> Score:
        """Return the score of these flights."""
        ended = list(results)
        times = [one.flight_time_s for one in ended if one.arrived]
        return cls(len(ended), len(times), statistics.fmean(times) if times else None)

    @property
    def rank(self) -> tuple[float, float]:
        """Less is better: first the share that arrives, then the mean time."""
        time = math.inf if self.flight_time_s is None else self.flight_time_s
        return -self.arrived / max(self.flights, 1), time

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the Wilson 95 % interval of the share, as JSON can hold them."""
        low, high = wilson(self.arrived, self.flights)
        return {**asdict(self), "success_low": low, "success_high": high}


@dataclass(frozen=True)
class Check:
    """Incumbent and best in the same fresh worlds."""

    incumbent: Score
    best: Score
    only_best: int
    """Worlds in which the best arrives and the incumbent does not."""
    only_incumbent: int
    faster: int
    """Worlds in which both arrive, the best earlier."""
    slower: int

    @classmethod
    def of(cls, incumbent: Sequence[FlightResult], best: Sequence[FlightResult]) -> Check:
        """Return the comparison of flights through the same worlds in the same order."""
        pairs = list(zip(incumbent, best, strict=True))
        times = [(old.flight_time_s, new.flight_time_s) for old, new in pairs if old.arrived and new.arrived]
        return cls(
            incumbent=Score.of(incumbent),
            best=Score.of(best),
            only_best=sum(new.arrived and not old.arrived for old, new in pairs),
            only_incumbent=sum(old.arrived and not new.arrived for old, new in pairs),
            faster=sum(new < old for old, new in times),
            slower=sum(new > old for old, new in times),
        )

    @property
    def verdict(self) -> Literal["better", "worse", "noise"]:
        """What a sign test over the worlds says of the best, 5 %: of arrivals; where those tell nothing, of times."""
        for won, lost in ((self.only_best, self.only_incumbent), (self.faster, self.slower)):
            if _is_beyond_chance(won, lost):
                return "better" if won > lost else "worse"
        return "noise"

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the verdict as JSON can hold them."""
        scores = {"incumbent": self.incumbent.to_dict(), "best": self.best.to_dict()}
        return {**asdict(self), **scores, "verdict": self.verdict}


@dataclass(frozen=True)
class Tuning:
    """What was tried, and what came of it."""

    spans: tuple[Span, ...]
    candidates: tuple[PlannerConfig, ...]
    """The first is the incumbent."""
    scores: tuple[Score, ...]
    """Of each candidate in the worlds that it flew, the fresh ones apart."""
    best: int
    """Index of the best candidate; 0 where none was better than the incumbent."""
    compared: int
    """Worlds that all candidates have flown which were left at the end; less than all after Ctrl-C."""
    check: Check | None
    """None after Ctrl-C, and where the incumbent is the best."""
    interrupted: bool

    @property
    def chosen(self) -> PlannerConfig:
        """The best candidate; the incumbent where the check shows that one to be better."""
        return self.candidates[0 if self.check and self.check.verdict == "worse" else self.best]

    def values(self, config: PlannerConfig) -> dict[str, float]:
        """Return the values of a configuration in what was tried."""
        return {span.path: float(config.get(span.path)) for span in self.spans}

    def to_dict(self) -> dict[str, Any]:
        """Return all of it as JSON can hold it."""
        tried = zip(self.candidates, self.scores, strict=True)
        return {
            "over": [asdict(span) for span in self.spans],
            "candidates": [{"values": self.values(config), **score.to_dict()} for config, score in tried],
            "best": self.best,
            "chosen": self.values(self.chosen),
            "compared": self.compared,
            "check": self.check and self.check.to_dict(),
            "interrupted": self.interrupted,
        }

    def format_table(self) -> str:
        """Return incumbent and best, in the search and in fresh worlds, and what to think of it, as text."""
        rows = [["", "flights", "arrived", "Wilson 95 %", "mean time", *(span.path for span in self.spans)]]
        rows.append(self._row("incumbent", 0, self.scores[0]))
        if self.best:
            rows.append(self._row("best", self.best, self.scores[self.best]))
        if self.check:
            rows.append(self._row("incumbent, fresh worlds", 0, self.check.incumbent))
            rows.append(self._row("best, fresh worlds", self.best, self.check.best))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, *self._conclusions()])

    def _row(self, name: str, index: int, score: Score) -> list[str]:
        low, high = wilson(score.arrived, score.flights)
        time = "-" if score.flight_time_s is None else f"{score.flight_time_s:.2f} s"
        share = f"{100.0 * low:.0f} to {100.0 * high:.0f} %"
        values = [f"{value:g}" for value in self.values(self.candidates[index]).values()]
        return [name, str(score.flights), str(score.arrived), share, time, *values]

    def _conclusions(self) -> list[str]:
        if not self.compared:
            return ["It was interrupted before all candidates had flown the same world: nothing is known."]
        if not self.best:
            return ["No candidate was better than the incumbent."]
        if self.check is None:
            return ["Warning: it was interrupted before the check; a winner looks better in its search than it is."]
        check = self.check
        told = (
            f"In fresh worlds the best alone arrives in {check.only_best}, the incumbent alone in "
            f"{check.only_incumbent}; where both do, the best is faster in {check.faster} and slower in {check.slower}."
        )
        verdict = {
            "better": "The best is better beyond chance (sign test, 5 %).",
            "worse": "Warning: the best is worse beyond chance (sign test, 5 %); the incumbent is kept.",
            "noise": "Warning: the difference is within the noise (sign test, 5 %); more flights may tell.",
        }
        return [told, verdict[check.verdict]]


def _is_beyond_chance(won: int, lost: int) -> bool:
    """Return whether a fair coin would hardly ever fall as unequally: the two-sided sign test."""
    trials, more = won + lost, max(won, lost)
    return 2 * sum(math.comb(trials, k) for k in range(more, trials + 1)) <= _CHANCE * 2**trials
