"""Success and speed in dense fields: many configurations over the same worlds, printed as they are flown.

    python -m benchmarks.agility --device cuda:0 --seeds 5000-5199
    python -m benchmarks.agility --seeds 1000-1063 --rows forest:100 inclines:400 --modes real --speeds 7 15 \
        --variant "look-ahead 8" anchors.lookahead=8 --variant "longer" anchors.lookahead=8 sampling.steps=30

Every variant is a preset, the default one unless --preset names another, with the changes that follow its name. Mode
"ideal" plans at 50 Hz and flies the planner's own model with exact states. Mode "real" plans at 10 Hz, with lags of
thrust and body rates of 40 and 30 ms, a drag of 0.25 1/s in gusts of 1.5 m/s, a latency of 20 ms, and noise of 3 cm, 5
cm/s and 0.5 deg in the state. Worlds without a path are left out.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules, StateNoise, VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.models import lidar_model
from aero_viz.statistics import wilson_interval
from benchmarks.common import make_world, split_change, value_of

ROWS = ("forest:100", "inclines:400", "verticals:300", "inclines:800", "verticals:600", "verticals:1000")
LAGS = {"thrust_lag": 0.04, "rate_lag": 0.03, "drag": 0.25, "gust_speed": 1.5, "latency": 0.02}
SOFT_CONTACT = 0.5
"""Speed up to which a collision counts as soft [m/s]."""
NOISE = StateNoise(position=0.03, velocity=0.05, attitude=0.5)
TICKS_PER_PLAN = {"ideal": 1, "real": 5}


def main() -> None:
    """Fly all variants and print a line per variant, mode, speed limit and row."""
    parser = make_flight_parser("agility", __doc__)
    parser.add_argument("--variant", nargs="+", action="append", metavar="NAME SECTION.KEY=VALUE", help="repeatable")
    options = parser.parse_args()
    deadline = time.monotonic() + options.budget
    worlds = passable_worlds(options)
    named = options.variant or [["default"]]
    variants = [(name, dict(map(split_change, words))) for name, *words in named]
    with open(options.output, "a", encoding="utf-8") as file:
        for name, changes in variants:
            for mode in options.modes:
                for speed in options.speeds:
                    if time.monotonic() > deadline:
                        print("out of time", flush=True)
                        return
                    for line in fly_rows(name, changes, mode, speed, worlds, options):
                        print(format_line(line), flush=True)
                        file.write(json.dumps(line) + "\n")
                        file.flush()


def fly_rows(
    name: str, changes: dict[str, str], mode: str, speed: float, worlds: dict[str, list[World]], options: Any
) -> Iterator[dict[str, Any]]:
    """Fly one variant in the worlds of all rows, in one batch per `options.batch` flights; yield a record per row."""
    changes = dict(changes)
    lidar = changes.pop("lidar", options.lidar)
    base = PlannerConfig.preset(options.preset)
    config = base.replace({"vehicle.speed_limit": speed} | {k: value_of(v) for k, v in changes.items()})
    flights = [(row, world) for row, row_worlds in worlds.items() for world in row_worlds]
    results: list[tuple[str, Any]] = []
    started = time.monotonic()
    for first in range(0, len(flights), options.batch):
        part = flights[first : first + options.batch]
        batch = FlightBatch(
            [world for _, world in part],
            config=config,
            device=options.device,
            seed=options.seed + first,
            lidar=lidar_model(lidar),
            vehicle=VehicleModel.from_config(config, **(LAGS if mode == "real" else {})),
            noise=NOISE if mode == "real" else None,
            rules=FlightRules(ticks_per_plan=TICKS_PER_PLAN[mode], time_limit=options.time_limit),
        )
        results += zip([row for row, _ in part], batch.run(), strict=True)
        batch.planner.close()
        del batch
    wall = time.monotonic() - started
    for row in worlds:
        flown = [result for result_row, result in results if result_row == row]
        arrived = [result for result in flown if result.arrived]
        yield {
            "variant": name, "mode": mode, "limit": speed, "row": row, "lidar": lidar,
            "changes": changes,
            "flights": len(flown), "arrived": len(arrived),
            "mean_speed": statistics.fmean(result.mean_speed for result in arrived) if arrived else None,
            "smoothness": statistics.fmean(result.smoothness for result in arrived) if arrived else None,
            "reasons": dict(Counter(result.reason for result in flown if not result.arrived)),
            "hard": sum(result.reason == "collision" and result.end_speed > SOFT_CONTACT for result in flown),
            "lost": [result.scene for result in flown if not result.arrived],
            "plan_ms": flown[0].plan_ms_median if flown else None, "wall_s": wall,
        }  # fmt: skip


def format_line(line: dict[str, Any]) -> str:
    """Return a record as one line of text."""
    low, high = wilson_interval(line["arrived"], line["flights"])
    speed = line["mean_speed"] or math.nan
    reasons = ", ".join(f"{count} {reason}" for reason, count in line["reasons"].items())
    reasons += f" ({line['hard']} above {SOFT_CONTACT} m/s)" if "collision" in line["reasons"] else ""
    return (
        f"{line['variant']:28} {line['mode']:5} {line['limit']:4g} {line['row']:15} "
        f"{line['arrived']:4}/{line['flights']:<4} {100 * line['arrived'] / max(line['flights'], 1):5.1f} % "
        f"({100 * low:.0f} to {100 * high:.0f}) {speed:5.2f} m/s {line['plan_ms'] or 0:6.2f} ms "
        f"{line['wall_s']:5.1f} s  {reasons}"
    )


def passable_worlds(options: Any) -> dict[str, list[World]]:
    """Return the passable worlds of each row, with the options of `make_flight_parser`."""
    first, _, last = options.seeds.partition("-")
    seeds = range(int(first), int(last or first) + 1)
    jobs = [(row, seed) for row in options.rows for seed in seeds]
    with ProcessPoolExecutor(options.processes) as pool:
        made = list(pool.map(make_world, *zip(*jobs, strict=True), chunksize=8))
    worlds: dict[str, list[World]] = {row: [] for row in options.rows}
    known = json.loads(options.passable.read_text()) if options.passable else None
    for (row, seed), world in zip(jobs, made, strict=True):
        key = f"{row}:{seed}"
        if known.get(key, True) if known is not None else _is_passable(world):
            worlds[row].append(world)
    return worlds


def _is_passable(world: World) -> bool:
    from aero_viz.scenes.passable import is_passable  # needs a CPU with Warp's compiler

    return is_passable(world)


def make_flight_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return the parser of `python -m benchmarks.NAME` with the options of worlds and flights."""
    parser = argparse.ArgumentParser(prog=f"python -m benchmarks.{name}", description=description)
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument("--rows", nargs="+", default=ROWS, help="SCENE or SCENE:COUNT")
    parser.add_argument("--seeds", default="5000-5199", help="range of the worlds' seeds")
    parser.add_argument("--seed", type=int, default=0, help="seed of sensor, noise and planner")
    parser.add_argument("--modes", nargs="+", default=list(TICKS_PER_PLAN), choices=TICKS_PER_PLAN)
    parser.add_argument("--speeds", nargs="+", type=float, default=[7.0], help="speed limits [m/s]")
    parser.add_argument("--preset", default="default", help="preset that the variants change")
    parser.add_argument("--lidar", default="mid360")
    parser.add_argument("--batch", type=int, default=1024, help="largest number of flights at once")
    parser.add_argument("--time-limit", type=float, default=60.0, help="rules.time_limit [s]")
    parser.add_argument("--budget", type=float, default=math.inf, help="start no variant after this wall time [s]")
    parser.add_argument("--passable", type=Path, help="JSON of ROW:SEED to true or false; computed by default")
    parser.add_argument("--processes", type=int, default=2, help="processes that make worlds")
    parser.add_argument("--output", type=Path, default=Path(f"{name}.jsonl"), help="file to append records to")
    return parser


if __name__ == "__main__":
    main()
