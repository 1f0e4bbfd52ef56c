"""Smoothness of the commands of flights with the lags of a drone with PX4, printed as a table.

    python -m benchmarks.smoothness --flights 128 --device cuda:0
    python -m benchmarks.smoothness --rows forest:5 verticals:300:7 --presets px4 \
        --variant "free choice" px4 costs.q_control_jump=0

A row is SCENE[:COUNT]:SPEED LIMIT. The vehicle has the response with which the rig flies the node, see
`aero_viz.rig.rig.PX4_RESPONSE`. The commands are those of every tick, of 20 ms; ticks after the end of a flight do not
count.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.cli_util import run_command
from aero_viz.flight import FlightBatch, FlightResult, FlightRules, VehicleModel
from aero_viz.rig.px4_log import count_sign_changes
from aero_viz.rig.rig import PX4_RESPONSE
from benchmarks.common import config_of, machine, make_world, positive, split_change, value_of

ROWS = ("forest:5", "forest:7", "inclines:300:5", "inclines:300:7", "verticals:300:5", "verticals:300:7")
HEADER = (
    "| configuration | scene, speed limit | arrived | sign changes per second: roll, pitch, yaw | ticks at the limit: "
    "roll, pitch, thrust | lowest, greatest height (mean) | mean speed |\n| --- | --- | --- | --- | --- | --- | --- |"
)


@dataclass(frozen=True)
class Commands:
    """Commands and heights of flights, tick by tick."""

    controls: NDArray[np.float64]
    """F_t [N] and omega [rad/s], shape [ticks, B, 4]."""
    heights: NDArray[np.float64]
    """[m], shape [ticks, B]."""
    flying: NDArray[np.bool_]
    """Whether a flight was still under way, shape [ticks, B]."""


def fly(batch: FlightBatch) -> Commands:
    """Fly all flights to their ends and return their commands."""
    vehicle, outcome = batch.simulator.vehicle, batch.simulator.outcome
    ticks: list[tuple[NDArray[Any], NDArray[Any], NDArray[Any]]] = []
    while (flying := outcome.numpy() == 0).any():
        batch.step()
        # Copies, since on a CPU these are views of the arrays of the flight.
        ticks.append((vehicle.recent_commands.numpy()[:, 0].copy(), vehicle.position.numpy()[:, 2].copy(), flying))
    controls, heights, flown = (np.array(values) for values in zip(*ticks, strict=True))
    return Commands(controls.astype(np.float64), heights.astype(np.float64), flown)


def summarize(
    commands: Commands, results: Sequence[FlightResult], config: PlannerConfig, period: float
) -> tuple[str, ...]:
    """Return the columns of a row of the table after the name of the configuration and of the scene.

    Args:
        commands: of all flights.
        results: of all flights, length B.
        config: gives the limits of the commands.
        period: duration of a tick [s].
    """
    flying, vehicle = commands.flying, config.vehicle
    changes = np.zeros(3)
    for b in range(flying.shape[1]):
        rates = commands.controls[flying[:, b], b, 1:]
        changes += [count_sign_changes(rates[:, axis]) for axis in range(3)]
    changes /= flying.sum() * period
    thrust, rates = commands.controls[flying][:, 0], np.abs(commands.controls[flying][:, 1:3])
    at_limit = (rates > 0.999 * vehicle.rate_xy_max).mean(axis=0)
    bounds = vehicle.thrust_min, vehicle.thrust_max
    thrust_at_limit = np.isclose(thrust[:, None], bounds, rtol=1e-3).any(axis=1).mean()
    lowest = np.where(flying, commands.heights, np.inf).min(axis=0).mean()
    greatest = np.where(flying, commands.heights, -np.inf).max(axis=0).mean()
    speeds = [result.mean_speed for result in results if result.arrived]
    return (
        f"{len(speeds)} of {len(results)}",
        ", ".join(f"{number:.1f}" for number in changes),
        ", ".join(f"{100 * share:.1f} %" for share in (*at_limit, thrust_at_limit)),
        f"{lowest:.2f}, {greatest:.2f} m",
        f"{np.mean(speeds):.1f} m/s" if speeds else "",
    )


def fly_rows(options: Any) -> Iterator[str]:
    """Fly every configuration in every row of the table and yield its lines."""
    configs = {name: config_of(name) for name in options.presets}
    for name, preset, *changes in options.variant:
        configs[name] = config_of(preset).replace({path: value_of(text) for path, text in map(split_change, changes)})
    rules = FlightRules(ticks_per_plan=options.ticks_per_plan, time_limit=options.time_limit)
    for row in options.rows:
        world_row, _, speed = row.rpartition(":")
        worlds = [make_world(world_row, options.first_seed + i) for i in range(options.flights)]
        for name, base in configs.items():
            config = base.replace({"vehicle.speed_limit": float(speed)})
            vehicle = VehicleModel.from_config(config, **PX4_RESPONSE)
            batch = FlightBatch(worlds, config=config, device=options.device, vehicle=vehicle, rules=rules)
            columns = summarize(fly(batch), batch.results(), config, rules.period)
            batch.planner.close()
            where = ", ".join((*world_row.split(":"), f"{speed} m/s"))
            yield f"| {' | '.join((name, where, *columns))} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: a configuration, a scene or a value is unknown or out of range.
    """
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.smoothness", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--device", default="cpu", help="cpu or cuda:0")
    parser.add_argument(
        "--rows", nargs="+", default=ROWS, metavar="SCENE[:COUNT]:SPEED", help="scenes and speed limits"
    )
    parser.add_argument("--presets", nargs="*", default=["default", "px4"], help="presets or configuration files")
    parser.add_argument("--variant", nargs="+", action="append", default=[], metavar="NAME PRESET SECTION.KEY=VALUE",
                        help="a preset with changed parameters; may be repeated")  # fmt: skip
    parser.add_argument("--flights", type=positive, default=12, help="flights per row, each in a world of its own")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first world")
    parser.add_argument("--ticks-per-plan", type=positive, default=1, help="ticks of 20 ms that are flown under a plan")
    parser.add_argument("--time-limit", type=float, default=60.0, help="longest flight [s]")
    options = parser.parse_args(arguments)
    period = 20 * options.ticks_per_plan
    print(f"{options.flights} flights per row, a plan every {period} ms, on {machine(options.device)}\n")
    print(HEADER)
    for line in fly_rows(options):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    run_command(main)
