"""Statistics of flights: the rows of a table, confidence intervals and tests."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, TypeAlias

METRICS = (
    "mean_speed", "max_speed", "smoothness", "length_m", "mean_clearance", "min_clearance", "flight_time_s",
)  # fmt: skip
"""Fields of `FlightResult` that are averaged over the flights that arrived, as in the paper's table."""
_SIGNIFICANCE = 0.05
Better: TypeAlias = Literal["A", "B", "noise"]


class Flown(Protocol):
    """Fields of a flight that a comparison needs."""

    @property
    def arrived(self) -> bool:
        """True if the flight arrived."""
        ...

    @property
    def flight_time_s(self) -> float:
        """Duration of the flight [s]."""
        ...


@dataclass(frozen=True)
class Summary:
    """One row of a table: the flights of one planner under the same conditions."""

    row: str
    planner: str
    flights: int
    """Number of flights."""
    arrived: int
    """Number of flights that arrived."""
    success_rate: float
    """arrived / flights."""
    success_low: float
    """Lower end of the 95 % Wilson interval of the success rate."""
    success_high: float
    """Upper end of the 95 % Wilson interval of the success rate."""
    passable: float | None
    """Share of the worlds in which there is a path for the drone's radius, None if that was not computed."""
    reasons: dict[str, int]
    """Number of flights by the reason for which they ended; "incomplete" for a recorded flight that just stops."""
    mean: dict[str, float | None]
    """Means of `METRICS` over the flights that arrived, None if none did."""
    std: dict[str, float | None]
    """Sample standard deviations of `METRICS` over the flights that arrived, None if fewer than two did."""
    plan_ms_median: float | None
    """Median over the batches of the time that a plan for the whole batch takes [ms]."""
    plan_ms_range: tuple[float, float] | None
    """Shortest and longest of these times [ms], None for fewer than two batches."""
    flights_per_minute: float | None
    """Flights per minute of wall time, None for flights of other planners."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as plain values for JSON."""
        return asdict(self)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a success rate, (0, 1) without trials."""
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials are not possible.")
    if trials == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest  # takes 0.5 s to import

    interval = binomtest(successes, trials).proportion_ci(method="wilson")
    return float(interval.low), float(interval.high)


def sign_test(wins: int, losses: int) -> float:
    """Return the p-value of the two-sided sign test: the chance of a split at least as uneven if both are as likely."""
    if wins + losses == 0:
        return 1.0
    from scipy.stats import binomtest

    return float(binomtest(wins, wins + losses).pvalue)


def _better(a: int, b: int) -> Better:
    """Return which of two has more wins, or "noise" if that is not significant."""
    return "noise" if sign_test(a, b) > _SIGNIFICANCE else "A" if a > b else "B"


def mean_interval(values: Sequence[float]) -> tuple[float, float, float] | None:
    """Return the mean of values and its 95 % interval by Student's t, or None for fewer than two values."""
    if len(values) < 2:
        return None
    from scipy.stats import t

    mean = statistics.fmean(values)
    half = float(t.ppf(0.975, len(values) - 1)) * statistics.stdev(values) / len(values) ** 0.5
    return mean, mean - half, mean + half


@dataclass(frozen=True)
class PairedComparison:
    """The comparison of flights A and B through the same worlds. A world counts once, however often it is flown."""

    pairs: int
    """Number of worlds."""
    flights: int
    """Number of flights of each of A and B."""
    arrived_a: int
    """Number of flights of A that arrive."""
    arrived_b: int
    """Number of flights of B that arrive."""
    only_a: int
    """Number of worlds in which more flights of A arrive: with one flight each, those in which only A arrives."""
    only_b: int
    """Number of worlds in which more flights of B arrive."""
    faster_a: int
    """Number of worlds in which A is earlier, in the mean over the flights that both arrive."""
    faster_b: int
    """Number of worlds in which B is earlier."""
    slower_by_s: tuple[float, float, float] | None = None
    """Mean of B's flight time less A's over the worlds in which both arrive [s], and its 95 % interval by Student's t;
    None for fewer than two such worlds."""

    @classmethod
    def from_flights(
        cls, flights_a: Sequence[Flown], flights_b: Sequence[Flown], worlds: Sequence[Hashable] | None = None
    ) -> PairedComparison:
        """Return the comparison of flights through the same worlds in the same order.

        Args:
            flights_a, flights_b: the flights.
            worlds: world of each flight; None if each is flown once.

        Raises:
            ValueError: the numbers of flights differ.
        """
        grouped: dict[Hashable, list[tuple[Flown, Flown]]] = {}
        for world, *pair in zip(range(len(flights_a)) if worlds is None else worlds, flights_a, flights_b, strict=True):
            grouped.setdefault(world, []).append((pair[0], pair[1]))
        arrived = [(sum(a.arrived for a, _ in pairs), sum(b.arrived for _, b in pairs)) for pairs in grouped.values()]
        both = [[b.flight_time_s - a.flight_time_s for a, b in pairs if a.arrived and b.arrived]
                for pairs in grouped.values()]  # fmt: skip
        later = [statistics.fmean(differences) for differences in both if differences]
        return cls(
            pairs=len(grouped),
            flights=len(flights_a),
            arrived_a=sum(a for a, _ in arrived),
            arrived_b=sum(b for _, b in arrived),
            only_a=sum(a > b for a, b in arrived),
            only_b=sum(b > a for a, b in arrived),
            faster_a=sum(difference > 0.0 for difference in later),
            faster_b=sum(difference < 0.0 for difference in later),
            slower_by_s=mean_interval(later),
        )

    @property
    def p_arrival(self) -> float:
        """P-value of the two-sided sign test on arrivals."""
        return sign_test(self.only_a, self.only_b)

    @property
    def p_time(self) -> float:
        """P-value of the two-sided sign test on the times of flights that both arrive."""
        return sign_test(self.faster_a, self.faster_b)

    @property
    def better_by_arrivals(self) -> Better:
        """The one of which more arrive, at the 5 % level."""
        return _better(self.only_a, self.only_b)

    @property
    def better_by_time(self) -> Better:
        """The one that is faster where both arrive, at the 5 % level."""
        return _better(self.faster_a, self.faster_b)

    @property
    def verdict(self) -> Better:
        """The better one at the 5 % level: by arrivals, and if these do not decide, by flight times."""
        return self.better_by_time if self.better_by_arrivals == "noise" else self.better_by_arrivals

    def to_dict(self) -> dict[str, Any]:
        """Return the fields, p-values and the verdict as plain values for JSON."""
        return {**asdict(self), "p_arrival": self.p_arrival, "p_time": self.p_time, "verdict": self.verdict}


def summarise(flights: Sequence[Mapping[str, Any]], *, row: str, planner: str) -> Summary:
    """Return the summary of flights, which are records of `Run.flights` or of `ExternalResults.flights`."""
    arrived = [flight for flight in flights if flight["arrived"]]
    low, high = wilson_interval(len(arrived), len(flights))
    values = {name: [float(flight[name]) for flight in arrived if flight.get(name) is not None] for name in METRICS}
    passable = [bool(flight["passable"]) for flight in flights if flight.get("passable") is not None]
    batches = {flight["batch"]: flight for flight in flights if "batch" in flight}
    seconds = sum(batch["run_s"] * _batch_share(batch, flights) for batch in batches.values())
    plan_ms = [batch["plan_ms_median"] for batch in batches.values() if batch["plan_ms_median"] is not None]
    return Summary(
        row=row,
        planner=planner,
        flights=len(flights),
        arrived=len(arrived),
        success_rate=len(arrived) / len(flights) if flights else 0.0,
        success_low=low,
        success_high=high,
        passable=sum(passable) / len(passable) if passable else None,
        reasons=dict(Counter(flight.get("reason") or "incomplete" for flight in flights).most_common()),
        mean={name: statistics.fmean(v) if v else None for name, v in values.items()},
        std={name: statistics.stdev(v) if len(v) > 1 else None for name, v in values.items()},
        plan_ms_median=statistics.median(plan_ms) if plan_ms else None,
        plan_ms_range=(min(plan_ms), max(plan_ms)) if len(plan_ms) > 1 else None,
        flights_per_minute=60.0 * len(flights) / seconds if seconds > 0.0 else None,
    )


def _batch_share(batch: Mapping[str, Any], flights: Sequence[Mapping[str, Any]]) -> float:
    """Return the share of a batch, which may have flights of other rows, that these flights make up."""
    return sum(flight.get("batch") == batch["batch"] for flight in flights) / batch["batch_size"]


@dataclass(frozen=True)
class SeedFlight:
    """How the flight of one seed ended."""

    outcome: str
    flight_time_s: float

    @property
    def arrived(self) -> bool:
        """True if it arrived."""
        return self.outcome == "arrived"


@dataclass(frozen=True)
class PairedSeeds:
    """The flights of A and of B so far, in the order of the seeds."""

    seeds: Sequence[int]
    a: Sequence[SeedFlight]
    b: Sequence[SeedFlight]

    @property
    def intervals(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """95 % Wilson intervals of the rates of success of A and B."""
        low, high = (wilson_interval(sum(one.arrived for one in flown), len(flown)) for flown in (self.a, self.b))
        return low, high

    @property
    def comparison(self) -> PairedComparison:
        """The paired comparison."""
        return PairedComparison.from_flights(self.a, self.b)
