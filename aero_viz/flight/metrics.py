"""What is known of a flight when it is over."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

__all__ = ["FlightResult", "flight_results"]


@dataclass(frozen=True)
class FlightResult:
    """Outcome and metrics of one flight, SI units; `simulator.Record` says how each is measured."""

    arrived: bool
    reason: str | None
    """"arrived", "collision", "stall", "out_of_bounds" or "timeout"; None while flying."""
    flight_time_s: float
    mean_speed: float
    """Length over time [m/s]."""
    max_speed: float
    smoothness: float
    """Integral of |da/dt|^2 dt [m^2/s^5]; smaller is smoother."""
    length_m: float
    mean_clearance: float | None
    """Mean over time of the distance to the nearest surface, ground included [m]; None in an empty world."""
    min_clearance: float | None
    """Smallest distance to a surface, ground included [m]; None in an empty world."""
    plan_ms_median: float | None
    """Median time of a plan, of the whole batch where flights share it [ms]; None when nothing was planned."""
    seed: int
    scene: str
    config: str
    explanation: str | None = None
    """In one sentence what ended the flight; None for an arrival."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON can hold them."""
        return dataclasses.asdict(self)

    def format_table(self) -> str:
        """Return the fields as text for a terminal, one per line."""
        return "\n".join(
            f"{name:16} {value:.3f}" if isinstance(value, float) else f"{name:16} {value}"
            for name, value in self.to_dict().items()
            if value is not None
        )


def flight_results(
    records: NDArray[Any],
    outcomes: Sequence[str | None],
    *,
    period: float,
    seeds: Sequence[int],
    scenes: Sequence[str],
    configs: Sequence[str],
    plan_ms: float | None,
    explanations: Sequence[str | None] | None = None,
) -> list[FlightResult]:
    """Return one result per flight from the simulator's records and outcomes; `period` is that of a tick [s]."""
    results = []
    told = explanations or [None] * len(outcomes)
    for record, outcome, seed, scene, config, explanation in zip(
        records, outcomes, seeds, scenes, configs, told, strict=True
    ):
        time, length = round(int(record["ticks"]) * period, 9), float(record["length"])
        results.append(
            FlightResult(
                arrived=outcome == "arrived",
                reason=outcome,
                flight_time_s=time,
                mean_speed=length / time if time > 0.0 else 0.0,
                max_speed=float(record["speed_max"]),
                smoothness=float(record["smoothness"]),
                length_m=length,
                mean_clearance=_finite(record["clearance_sum"] / record["clearance_count"]),
                min_clearance=_finite(record["clearance_min"]),
                plan_ms_median=plan_ms,
                seed=seed,
                scene=scene,
                config=config,
                explanation=explanation,
            )
        )
    return results


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
