"""Results and metrics of flights, simulated or recorded."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.warp_init import init_warp
from aero_viz.flight.explanation import explain
from aero_viz.flight.flight_end import FlightRecord, RuleParameters, judge_trajectory_kernel
from aero_viz.flight.rules import OUTCOMES, FlightRules
from aero_viz.scenes.world import World

_UNITS = {
    "mean_speed": "m/s", "max_speed": "m/s", "end_speed": "m/s", "smoothness": "m^2/s^5", "mean_clearance": "m",
    "min_clearance": "m",
}  # fmt: skip
"""Units of the fields of a result whose names do not say them."""

_TICKS_MAX = 2**31 - 1
_TICK_ROUNDING = 1e-6
"""A time that is longer than a whole number of ticks by less than this share of one is that number."""


@dataclass(frozen=True)
class FlightResult:
    """Outcome and metrics of one flight, in SI units; `flight_end.FlightRecord` defines how each is measured."""

    arrived: bool
    reason: str | None
    """"arrived", "collision", "stall", "out_of_bounds", "timeout" or "planner_failed"; None for one that has not
    ended."""
    flight_time_s: float
    mean_speed: float
    """Length over time [m/s]."""
    max_speed: float
    end_speed: float
    """Speed at the end, for a collision at contact [m/s]."""
    smoothness: float
    """Integral of |da/dt|^2 dt [m^2/s^5]; smaller is smoother."""
    length_m: float
    mean_clearance: float | None
    """Mean over time of the distance to the nearest surface, ground included [m]; None in an empty world."""
    min_clearance: float | None
    """Smallest distance to a surface, ground included [m]; None in an empty world."""
    plan_ms_median: float | None
    """Median time of a plan, or of a plan of the whole batch [ms]; None if nothing was planned."""
    seed: int
    scene: str
    config: str
    explanation: str | None = None
    """One sentence on how the flight ended, after one for each waypoint that was given up; None for an arrival."""
    waypoints: int | None = None
    """Number of waypoints of the mission; None for a single goal."""
    waypoints_passed: int | None = None
    """Number of waypoints that were passed or stopped at, in their order; None for a single goal."""

    def to_dict(self) -> dict[str, Any]:
        """Return the fields in a form that JSON can represent."""
        return dataclasses.asdict(self)

    def format_table(self) -> str:
        """Return the fields as text for a terminal, one per line, with their units."""
        return "\n".join(
            f"{name:16} {f'{value:.3f}' if isinstance(value, float) else value} {_UNITS.get(name, '')}".rstrip()
            for name, value in self.to_dict().items()
            if value is not None
        )


def flight_results(
    records: NDArray[Any],
    outcomes: Sequence[str | None],
    worlds: Sequence[World],
    positions: ArrayLike,
    *,
    rules: FlightRules,
    seeds: Sequence[int],
    configs: Sequence[str],
    plan_ms: float | None,
) -> list[FlightResult]:
    """Return one result per flight.

    Args:
        records: `FlightRecord` of each flight, structured array [B].
        outcomes: [B].
        worlds: [B].
        positions: last position of each flight [m], [B, 3].
        rules: of all flights.
        seeds: [B].
        configs: names of the configurations, [B].
        plan_ms: field `plan_ms_median` of all results.
    """
    results = []
    flights = zip(records, outcomes, worlds, np.asarray(positions), seeds, configs, strict=True)
    for record, outcome, world, position, seed, config in flights:
        time, length = round(int(record["ticks"]) * rules.period, 9), float(record["length"])
        clearance, goal = float(record["clearance_min"]), record["goal"]
        result = FlightResult(
            arrived=outcome == "arrived",
            reason=outcome,
            flight_time_s=time,
            mean_speed=length / time if time > 0.0 else 0.0,
            max_speed=float(record["speed_max"]),
            end_speed=float(np.linalg.norm(record["velocity"])),
            smoothness=float(record["smoothness"]),
            length_m=length,
            mean_clearance=_finite(record["clearance_sum"] / record["clearance_count"]),
            min_clearance=_finite(clearance),
            plan_ms_median=plan_ms,
            seed=seed,
            scene=world.name,
            config=config,
            explanation=explain(
                outcome, world.at(time), position, time=time, clearance=clearance, goal=goal, rules=rules
            ),
        )
        results.append(result)
    return results


def initial_records(starts: NDArray[np.float64], goals: NDArray[np.float64]) -> NDArray[Any]:
    """Return the `FlightRecord` of flights that have not begun, structured array [B].

    Args:
        starts: first positions [m], [B, 3].
        goals: [m], [B, 3].
    """
    struct: Any = FlightRecord
    records = np.zeros(len(starts), dtype=np.dtype(struct.numpy_dtype()))
    records["goal"] = goals
    records["is_last"] = 1
    records["clearance_min"] = np.inf
    records["progress_position"] = starts
    return records


def pack_rules(rules: FlightRules) -> Any:
    """Return the `RuleParameters` of rules."""
    parameters: Any = RuleParameters()
    for name in ("period", "radius", "arrival_radius", "stall_distance"):
        setattr(parameters, name, getattr(rules, name))
    parameters.stall_ticks, parameters.limit_ticks = (
        min(math.ceil(seconds / rules.period - _TICK_ROUNDING), _TICKS_MAX)
        for seconds in (rules.stall_time, rules.time_limit)
    )
    return parameters


def judge_trajectory(
    world: World,
    positions: NDArray[np.float64],
    velocities: NDArray[np.float64],
    clearance: NDArray[np.float64],
    *,
    rules: FlightRules,
) -> tuple[NDArray[Any], str | None]:
    """Return the `FlightRecord`, structured array [1], and the outcome of a recorded flight.

    It ends at the first tick that ends a simulated flight. The outcome is None if there is no such tick.

    Args:
        world: goal and bounds.
        positions: positions at the ticks [m], [n, 3], n >= 1.
        velocities: velocities at the ticks [m/s], [n, 3].
        clearance: distances to the nearest surface at the S integration steps of each tick [m], [n, S].
        rules: when the flight ends.
    """
    init_warp()
    with wp.ScopedDevice("cpu"):
        record = wp.array(initial_records(positions[:1], world.goal[None]), dtype=FlightRecord)
        outcome = wp.zeros(1, dtype=int)
        inputs = [pack_rules(rules), wp.vec3(*world.bounds[0]), wp.vec3(*world.bounds[1])]
        inputs += [wp.array(table, dtype=wp.vec3) for table in (positions, velocities)]
        inputs += [wp.array(clearance, dtype=float)]
        wp.launch(judge_trajectory_kernel, 1, inputs=inputs, outputs=[record, outcome])
    return record.numpy(), OUTCOMES[int(outcome.numpy()[0])]


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
