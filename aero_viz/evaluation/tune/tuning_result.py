"""The result of a search: scores, the check in fresh worlds, and the conclusion from both."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from aero_planner.config import DroneConfig
from aero_viz.evaluation.tune.objectives import NAMES, OBJECTIVES, UNITS, Objective, measure
from aero_viz.evaluation.tune.search_space import ParameterRange
from aero_viz.flight import FlightResult
from aero_viz.statistics import PairedComparison, wilson_interval
from aero_viz.text_table import format_table


@dataclass(frozen=True)
class Score:
    """The outcome of a candidate's flights."""

    flights: int
    """Number of flights."""
    arrived: int
    """Number of flights that arrived."""
    flight_time_s: float | None
    """Mean time of the flights that arrived [s], None if none did."""
    flight_time_std_s: float | None = None
    """Sample standard deviation of these times [s], None if fewer than two flights arrived."""
    others: dict[str, list[float | None]] = field(default_factory=dict)
    """The same two figures of the other objectives, by name."""

    @classmethod
    def from_results(cls, results: Iterable[FlightResult]) -> Score:
        """Return the score of flights."""
        flights = list(results)
        arrived = [flight for flight in flights if flight.arrived]
        figures: dict[str, list[float | None]] = {
            name: _mean_std([measure(flight, name) for flight in arrived]) for name in OBJECTIVES
        }
        time, deviation = figures.pop("time")
        return cls(len(flights), len(arrived), time, deviation, figures)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields and the 95 % Wilson interval of the share as plain values for JSON."""
        low, high = wilson_interval(self.arrived, self.flights)
        return {**asdict(self), "success_low": low, "success_high": high}


@dataclass(frozen=True)
class Check:
    """The comparison of the incumbent and the best candidate in the same fresh worlds."""

    incumbent: Score
    best: Score
    paired: PairedComparison
    """A is the incumbent and B the best candidate."""

    @classmethod
    def from_results(cls, incumbent: Sequence[FlightResult], best: Sequence[FlightResult]) -> Check:
        """Return the comparison of flights through the same worlds in the same order."""
        paired = PairedComparison.from_flights(incumbent, best)
        return cls(Score.from_results(incumbent), Score.from_results(best), paired)

    @property
    def verdict(self) -> Literal["better", "worse", "noise"]:
        """Verdict on the best candidate by sign tests over the worlds at the 5 % level."""
        verdicts: dict[str, Literal["better", "worse", "noise"]] = {"A": "worse", "B": "better", "noise": "noise"}
        return verdicts[self.paired.verdict]

    def to_dict(self) -> dict[str, Any]:
        """Return the scores, the comparison and the verdict as plain values for JSON."""
        return {
            "incumbent": self.incumbent.to_dict(),
            "best": self.best.to_dict(),
            "only_best": self.paired.only_b,
            "only_incumbent": self.paired.only_a,
            "faster": self.paired.faster_b,
            "slower": self.paired.faster_a,
            "verdict": self.verdict,
        }


@dataclass(frozen=True)
class Candidate:
    """A configuration and its flights in the worlds of the search."""

    trial: int | None
    """Number of the trial in Optuna's study; None for the incumbent."""
    config: DroneConfig
    values: tuple[float, ...]
    """Cost that the search minimises, infinite where no flight arrived."""
    flights: tuple[FlightResult, ...]
    """One per world, in which it flew before it was given up."""
    is_complete: bool
    """True if it flew in all worlds."""

    @property
    def score(self) -> Score:
        """Outcome of the flights."""
        return Score.from_results(self.flights)


@dataclass(frozen=True)
class TuningResult:
    """The candidates of a search, and the conclusion."""

    study: str
    """Name of Optuna's study."""
    ranges: tuple[ParameterRange, ...]
    """The tuned parameters."""
    objectives: tuple[Objective, ...]
    """Objectives besides arrivals."""
    incumbent: DroneConfig
    candidates: tuple[Candidate, ...]
    """The first one is the incumbent; empty if Ctrl-C came before it had flown."""
    best: Candidate | None
    """The best candidate, which is the incumbent if no other one is better; None without candidates."""
    front: tuple[Candidate, ...]
    """Candidates that no other one beats in all objectives. With one objective these are the best."""
    check: Check | None
    """None after Ctrl-C, or if the incumbent is the best."""
    interrupted: bool
    """True after Ctrl-C."""

    @property
    def chosen(self) -> DroneConfig:
        """The best candidate, unless the check shows that the incumbent is better."""
        keep = self.best is None or (self.check is not None and self.check.verdict == "worse")
        return self.incumbent if self.best is None or keep else self.best.config

    def values(self, config: DroneConfig) -> dict[str, float]:
        """Return the values of the tuned parameters in a configuration, by path."""
        return {parameter.path: float(config.get(parameter.path)) for parameter in self.ranges}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return {
            "study": self.study,
            "over": [asdict(parameter) for parameter in self.ranges],
            "objectives": list(self.objectives),
            "candidates": [self._describe(candidate) for candidate in self.candidates],
            "best": self.best and self._describe(self.best),
            "front": [self._describe(candidate) for candidate in self.front],
            "chosen": self.values(self.chosen),
            "check": self.check and self.check.to_dict(),
            "interrupted": self.interrupted,
        }

    def format_table(self) -> str:
        """Return a table of the incumbent and the best candidates, followed by the conclusions, as text."""
        means = ["mean time", *(f"mean {NAMES[name]} [{UNITS[name]}]" for name in self.objectives if name != "time")]
        header = ["", "flights", "arrived", "Wilson 95 %", *means, *(parameter.path for parameter in self.ranges)]
        rows = [self._row("incumbent", c.score, c.config) for c in self.candidates[:1]]
        if len(self.objectives) > 1:
            rows += [self._row(f"front, trial {c.trial}", c.score, c.config) for c in self.front if c.trial is not None]
        elif self.best and self.best.trial is not None:
            rows.append(self._row(f"best, trial {self.best.trial}", self.best.score, self.best.config))
        if self.check and self.best:
            rows.append(self._row("incumbent, fresh worlds", self.check.incumbent, self.incumbent))
            rows.append(self._row("best, fresh worlds", self.check.best, self.best.config))
        return "\n".join([format_table(rows, header=header), *self._conclusions()])

    def _describe(self, candidate: Candidate) -> dict[str, Any]:
        score = candidate.score
        means = {name: score.flight_time_s if name == "time" else score.others[name][0] for name in self.objectives}
        costs = [value if math.isfinite(value) else None for value in candidate.values]
        about = {"trial": candidate.trial, "values": self.values(candidate.config), "objectives": means, "costs": costs}
        return {**about, "is_complete": candidate.is_complete, **score.to_dict()}

    def _row(self, name: str, score: Score, config: DroneConfig) -> list[str]:
        low, high = wilson_interval(score.arrived, score.flights)
        means = [_format(score.flight_time_s, score.flight_time_std_s, " s")]
        means += [_format(mean, std) for mean, std in (score.others[n] for n in self.objectives if n != "time")]
        interval = f"{100.0 * low:.0f} to {100.0 * high:.0f} %"
        values = [f"{value:g}" for value in self.values(config).values()]
        return [name, str(score.flights), str(score.arrived), interval, *means, *values]

    def _conclusions(self) -> list[str]:
        if self.best is None:
            return ["No conclusion: the search was interrupted before the incumbent had flown."]
        if self.best.trial is None:
            return ["No candidate was better than the incumbent."]
        if self.check is None:
            return ["Warning: the search was interrupted before the check; the score of its winner is optimistic."]
        paired = self.check.paired
        comparison = (
            f"In fresh worlds only the best candidate arrives in {paired.only_b}, only the incumbent in "
            f"{paired.only_a}; where both arrive, the best is faster in {paired.faster_b} and slower in "
            f"{paired.faster_a}."
        )
        verdict = {
            "better": "The best candidate is significantly better (sign test, 5 %).",
            "worse": "Warning: the best candidate is significantly worse (sign test, 5 %); the incumbent is kept.",
            "noise": "Warning: the difference is not significant (sign test, 5 %); fly more flights to find out.",
        }
        return [comparison, verdict[self.check.verdict]]


def _mean_std(values: Sequence[float]) -> list[float | None]:
    return [statistics.fmean(values) if values else None, statistics.stdev(values) if len(values) > 1 else None]


def _format(mean: float | None, std: float | None, unit: str = "") -> str:
    return "-" if mean is None else f"{mean:.2f}{unit}" + ("" if std is None else f" ± {std:.2f}")
