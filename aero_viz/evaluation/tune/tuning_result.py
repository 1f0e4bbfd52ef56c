"""The result of a search: scores, the check in fresh worlds, and the conclusion from both."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from aero_planner import PlannerConfig
from aero_viz.evaluation.statistics import sign_test, wilson_interval
from aero_viz.evaluation.tune.search_space import ParameterRange
from aero_viz.flight import FlightResult
from aero_viz.text_table import format_table

__all__ = ["Check", "Score", "TuningResult"]

_SIGNIFICANCE = 0.05


@dataclass(frozen=True)
class Score:
    """The outcome of a candidate's flights."""

    flights: int
    """Number of flights."""
    arrived: int
    """Number of flights that arrived."""
    flight_time_s: float | None
    """Mean time of the flights that arrived [s], None if none did."""

    @classmethod
    def from_results(cls, results: Iterable[FlightResult]) -> Score:
        """Return the score of flights."""
        flights = list(results)
        times = [flight.flight_time_s for flight in flights if flight.arrived]
        return cls(len(flights), len(times), statistics.fmean(times) if times else None)

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key, smaller is better: first the share of flights that arrived, then the mean time."""
        time = math.inf if self.flight_time_s is None else self.flight_time_s
        return -self.arrived / max(self.flights, 1), time

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the 95 % Wilson interval of the share as plain values for JSON."""
        low, high = wilson_interval(self.arrived, self.flights)
        return {**asdict(self), "success_low": low, "success_high": high}


@dataclass(frozen=True)
class Check:
    """The comparison of the incumbent and the best candidate in the same fresh worlds."""

    incumbent: Score
    best: Score
    only_best: int
    """Number of worlds in which the best candidate arrives and the incumbent does not."""
    only_incumbent: int
    """Number of worlds in which the incumbent arrives and the best candidate does not."""
    faster: int
    """Number of worlds in which both arrive, the best candidate earlier."""
    slower: int
    """Number of worlds in which both arrive, the best candidate later."""

    @classmethod
    def from_results(cls, incumbent: Sequence[FlightResult], best: Sequence[FlightResult]) -> Check:
        """Return the comparison of flights through the same worlds in the same order."""
        pairs = list(zip(incumbent, best, strict=True))
        times = [(old.flight_time_s, new.flight_time_s) for old, new in pairs if old.arrived and new.arrived]
        return cls(
            incumbent=Score.from_results(incumbent),
            best=Score.from_results(best),
            only_best=sum(new.arrived and not old.arrived for old, new in pairs),
            only_incumbent=sum(old.arrived and not new.arrived for old, new in pairs),
            faster=sum(new < old for old, new in times),
            slower=sum(new > old for old, new in times),
        )

    @property
    def verdict(self) -> Literal["better", "worse", "noise"]:
        """Verdict on the best candidate by sign tests over the worlds at the 5 % level.

        The first test is on arrivals. If it is not significant, the second one is on flight times.
        """
        for wins, losses in ((self.only_best, self.only_incumbent), (self.faster, self.slower)):
            if sign_test(wins, losses) <= _SIGNIFICANCE:
                return "better" if wins > losses else "worse"
        return "noise"

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the verdict as plain values for JSON."""
        scores = {"incumbent": self.incumbent.to_dict(), "best": self.best.to_dict()}
        return {**asdict(self), **scores, "verdict": self.verdict}


@dataclass(frozen=True)
class TuningResult:
    """The candidates of a search and their scores."""

    ranges: tuple[ParameterRange, ...]
    """The tuned parameters."""
    candidates: tuple[PlannerConfig, ...]
    """The first one is the incumbent."""
    scores: tuple[Score, ...]
    """Score of each candidate in the worlds of the search that it flew in."""
    best: int
    """Index of the best candidate, 0 if none was better than the incumbent."""
    compared: int
    """Number of worlds in which all candidates that remained at the end have flown; fewer than all after Ctrl-C."""
    check: Check | None
    """None after Ctrl-C, or if the incumbent is the best."""
    interrupted: bool
    """True after Ctrl-C."""

    @property
    def chosen(self) -> PlannerConfig:
        """The best candidate, unless the check shows that the incumbent is better."""
        return self.candidates[0 if self.check and self.check.verdict == "worse" else self.best]

    def values(self, config: PlannerConfig) -> dict[str, float]:
        """Return the values of the tuned parameters in a configuration, by path."""
        return {parameter.path: float(config.get(parameter.path)) for parameter in self.ranges}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        scored = zip(self.candidates, self.scores, strict=True)
        return {
            "over": [asdict(parameter) for parameter in self.ranges],
            "candidates": [{"values": self.values(config), **score.to_dict()} for config, score in scored],
            "best": self.best,
            "chosen": self.values(self.chosen),
            "compared": self.compared,
            "check": self.check and self.check.to_dict(),
            "interrupted": self.interrupted,
        }

    def format_table(self) -> str:
        """Return a table of the incumbent and the best candidate, followed by the conclusions, as text."""
        header = ["", "flights", "arrived", "Wilson 95 %", "mean time", *(parameter.path for parameter in self.ranges)]
        rows = [self._row("incumbent", 0, self.scores[0])]
        if self.best:
            rows.append(self._row("best", self.best, self.scores[self.best]))
        if self.check:
            rows.append(self._row("incumbent, fresh worlds", 0, self.check.incumbent))
            rows.append(self._row("best, fresh worlds", self.best, self.check.best))
        return "\n".join([format_table(rows, header=header), *self._conclusions()])

    def _row(self, name: str, index: int, score: Score) -> list[str]:
        low, high = wilson_interval(score.arrived, score.flights)
        time = "-" if score.flight_time_s is None else f"{score.flight_time_s:.2f} s"
        interval = f"{100.0 * low:.0f} to {100.0 * high:.0f} %"
        values = [f"{value:g}" for value in self.values(self.candidates[index]).values()]
        return [name, str(score.flights), str(score.arrived), interval, time, *values]

    def _conclusions(self) -> list[str]:
        if not self.compared:
            return ["No conclusion: the search was interrupted before all candidates had flown in the same world."]
        if not self.best:
            return ["No candidate was better than the incumbent."]
        if self.check is None:
            return [
                "Warning: the search was interrupted before the check, and its winner looks better in it than it is."
            ]
        check = self.check
        comparison = (
            f"In fresh worlds only the best candidate arrives in {check.only_best}, only the incumbent in "
            f"{check.only_incumbent}; where both arrive, the best is faster in {check.faster} and slower in "
            f"{check.slower}."
        )
        verdict = {
            "better": "The best candidate is significantly better (sign test, 5 %).",
            "worse": "Warning: the best candidate is significantly worse (sign test, 5 %); the incumbent is kept.",
            "noise": "Warning: the difference is not significant (sign test, 5 %); fly more flights to find out.",
        }
        return [comparison, verdict[check.verdict]]
