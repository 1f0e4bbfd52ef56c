"""Effects of many parameters at once on success and speed in dense fields, printed as a table.

    python -m benchmarks.screening --device cuda:0 --rows inclines:800 --seeds 40000-40095 --configurations 106 \
        --change costs.q_position 2 5 --change costs.q_control 0.25 1 --change sampling.temperature 0.03 0.3

Each configuration has every parameter at its default, with a probability of one half, or else at one of the two values
given. The first is the default. A linear model of the mean speeds and of the shares of flights that failed gives the
effect of each value alone. Every flight counts for every parameter, so that 100 configurations suffice for some 30. The
model has no interactions: fly the chosen combinations with `python -m benchmarks.agility`, in other worlds.

Modes, rows and the other options are those of `benchmarks.agility`.
"""

from __future__ import annotations

import json
import math
import random
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from aero_planner import PlannerConfig
from aero_planner.cli_util import run_command
from benchmarks.agility import fly_rows, make_flight_parser, passable_worlds
from benchmarks.common import positive, value_of

Change = tuple[str, str]
"""Path and value of a parameter, as text."""


class Effect(NamedTuple):
    """Difference that a change makes, with its standard error."""

    value: float
    error: float


def draw_designs(changes: Sequence[Sequence[Change]], count: int, *, seed: int) -> list[dict[str, str]]:
    """Return the changes of each configuration; the first has none.

    Args:
        changes: for each parameter, its changes, of which a configuration has at most one.
        count: number of configurations.
        seed: seed of the choice.
    """
    rng = random.Random(seed)
    drawn = [dict(rng.choice(own) for own in changes if rng.random() < 0.5) for _ in range(count - 1)]
    return [{}, *drawn]


def fit_effects(
    designs: Sequence[dict[str, str]], changes: Sequence[Change], outcomes: ArrayLike
) -> dict[Change, Effect]:
    """Return the effect of each change in the linear model that fits the outcomes of all designs best.

    Args:
        designs: changes of each configuration, as of `draw_designs`.
        changes: the changes to look at.
        outcomes: one number per configuration, shape [n].

    Raises:
        ValueError: there are not more configurations than changes, or two changes always come together.
    """
    columns = [[1.0, *(float(design.get(path) == value) for path, value in changes)] for design in designs]
    X, y = np.array(columns), np.asarray(outcomes, dtype=np.float64)
    freedom = len(X) - X.shape[1]
    if freedom < 1 or np.linalg.matrix_rank(X) < X.shape[1]:
        raise ValueError(f"{len(X)} configurations are too few for {len(changes)} changes; give more --configurations.")
    solution = np.linalg.lstsq(X, y)[0]
    variance = float(((y - X @ solution) ** 2).sum()) / freedom
    errors = np.sqrt(variance * np.diag(np.linalg.inv(X.T @ X)))
    return {
        change: Effect(float(value), float(error))
        for change, value, error in zip(changes, solution[1:], errors[1:], strict=True)
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly all configurations and print the effects for each mode and speed limit; return 0."""
    parser = make_flight_parser("screening", __doc__)
    parser.add_argument("--configurations", type=positive, default=100, help="number of configurations to fly")
    parser.add_argument(
        "--change", nargs="+", action="append", required=True, metavar="SECTION.KEY VALUE", help="repeatable"
    )
    options = parser.parse_args(arguments)
    grouped = [[(path, value) for value in values] for path, *values in options.change]
    changes = [change for own in grouped for change in own]
    if not all(grouped):
        raise ValueError("--change takes the name of a parameter and one value or more, such as costs.q_position 2 5.")
    for path, value in changes:
        PlannerConfig().replace({path: value_of(value)})  # a mistake is an error before the first flight
    designs = draw_designs(grouped, options.configurations, seed=options.seed)
    worlds = passable_worlds(options)
    deadline = time.monotonic() + options.budget
    for mode in options.modes:
        for speed in options.speeds:
            flown, speeds, failures = [], [], []
            for i, design in enumerate(designs):
                if flown and time.monotonic() > deadline:
                    print("out of time", flush=True)
                    break
                lines = list(fly_rows(str(i), design, mode, speed, worlds, options))
                with open(options.output, "a", encoding="utf-8") as file:
                    file.writelines(json.dumps(line) + "\n" for line in lines)
                flights, arrived = (sum(line[name] for line in lines) for name in ("flights", "arrived"))
                flown.append(design)
                failures.append(100.0 * (1.0 - arrived / flights))
                total = sum(line["arrived"] * (line["mean_speed"] or 0.0) for line in lines)
                speeds.append(total / arrived if arrived else math.nan)
            print(f"{mode}, {speed:g} m/s, {len(flown)} configurations, default: {speeds[0]:.2f} m/s")
            print(_format_effects(flown, changes, speeds, failures), flush=True)
    return 0


def _format_effects(
    designs: Sequence[dict[str, str]], changes: Sequence[Change], speeds: Sequence[float], failures: Sequence[float]
) -> str:
    """Return the effects as a table in Markdown; without a speed, a configuration does not count."""
    kept = [i for i, speed in enumerate(speeds) if math.isfinite(speed)]
    faster = fit_effects([designs[i] for i in kept], changes, [speeds[i] for i in kept])
    worse = fit_effects(designs, changes, failures)
    rows = [
        f"| `{path}` {value} | {faster[path, value].value:+.2f} ± {faster[path, value].error:.2f} "
        f"| {worse[path, value].value:+.1f} ± {worse[path, value].error:.1f} |"
        for path, value in changes
    ]
    return "\n".join(["| change | speed [m/s] | failures [percentage points] |", "| --- | --- | --- |", *rows])


if __name__ == "__main__":
    run_command(main)
