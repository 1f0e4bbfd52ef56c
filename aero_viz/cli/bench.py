"""Verbs of the command line that measure: `aero-viz bench`, `score`, `world export`."""

from __future__ import annotations

import contextlib
import json as json_module
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import tyro

from aero_viz.cli.flags import (
    ConfigFlags,
    FileName,
    FlightFlags,
    Inline,
    OutputPath,
    RulesFlags,
    WorldFlags,
    WorldName,
    flight_rules,
)
from aero_viz.errors import UserError

__all__ = ["VERBS", "progress_bar"]

_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_RULES = RulesFlags()
_WORLD = WorldFlags()


def bench(
    name: tyro.conf.Positional[Literal["table2", "success", "density", "rooms", "ablation", "default", "scaling"]],
    *,
    device: str = "cpu",
    flights: int = 50,
    seed: int = 0,
    lidar: Literal["mid360", "full-sphere", "spinning64"] | None = None,
    batch: int | None = None,
    output: Path | None = None,
    resume: bool = False,
    include: tuple[str, ...] = (),
    json: bool = False,
    flight: Inline[FlightFlags] = _FLIGHT,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a benchmark and write its tables, plots and report.

    table2: the paper's three scenes at 7 m/s. success: velocity limits of 1 to 7 m/s. density: 200 to 1000 obstacles.
    rooms: four indoor rooms. ablation: each mechanism on its own. default: acceptance of the default configuration.
    scaling: flights per minute over the batch. Ctrl-C keeps what is finished; --resume goes on.

    Args:
        name: of the benchmark.
        device: Warp device, such as cpu or cuda:0.
        flights: worlds of each row.
        seed: first seed of the worlds, LiDARs and planners.
        lidar: LiDAR in the place of each row's own.
        batch: flights at once at most; 256 on a GPU and 1 on the CPU when left out.
        output: folder of the results; results/NAME when left out.
        resume: go on with what the folder holds.
        include: flights of other planners, each NAME=TABLE.csv as `score --table` writes it, or
            NAME=FLIGHT@WORLD.json.
        json: print one JSON object.
        flight: the flight.
        flags: the planner's configuration.
    """
    from aero_planner.config.file import config_from_name
    from aero_viz.evaluation.bench.catalog import BENCHMARKS
    from aero_viz.evaluation.bench.include import load_included
    from aero_viz.evaluation.bench.report import format_summaries, format_worlds, world_records, write_report
    from aero_viz.evaluation.bench.runner import load_run, run_benchmark

    benchmark, folder, config = BENCHMARKS[name], output or Path("results") / name, flags.load()
    changed = config != config_from_name(flags.config)
    included = load_included(include, benchmark)
    try:
        with progress_bar() as progress:
            run = run_benchmark(
                benchmark,
                folder,
                flights=flights,
                seed=seed,
                config=config,
                config_name=f"{flags.config}, changed" if changed else flags.config,
                device=device,
                lidar=lidar,
                batch=batch,
                resume=resume,
                rules=flight.flight_rules(),
                noise=flight.state_noise(),
                drone=flight.drone_changes,
                sensor=flight.lidar_changes,
                progress=progress,
            )
        summaries = write_report(run, folder, included=included)
    except KeyboardInterrupt:
        run = load_run(folder, benchmark)
        write_report(run, folder, included=included)
        kept = f"{len(run.flights)} of {run.total} flights are kept in {folder}"
        print(f"{kept}; --resume with the same options goes on.", file=sys.stderr)
        raise SystemExit(130) from None
    except RuntimeError as error:
        raise UserError(f"The benchmark cannot run on {device}: {error}") from error
    if json:
        content = {**run.header, "output": str(folder), "summary": [line.to_dict() for line in summaries]}
        content["worlds"] = world_records(run)
        print(json_module.dumps(content, allow_nan=False))
    else:
        print(format_summaries(summaries), *format_worlds(run), folder / "report.md", sep="\n")


def score(
    flight: FileName,
    *,
    world: str,
    seed: int = 0,
    pose_topic: str | None = None,
    planner: str = "recorded",
    table: Path | None = None,
    json: bool = False,
    place: Inline[WorldFlags] = _WORLD,
    rules: RulesFlags = _RULES,
) -> None:
    """Measure a flight of any planner as the simulator measures its own.

    Args:
        flight: CSV file with t,x,y,z and, where known, vx,vy,vz, or a ROS bag or MCAP file with Odometry.
        world: where it was flown: a world's JSON file, a scene's name, a map of points or a mesh.
        seed: of the scene.
        pose_topic: topic of the poses; found by its type when left out.
        planner: who flew.
        table: CSV file to append the result to, for `bench --include`.
        json: print one JSON object.
        place: the world.
        rules: when a flight ends.
    """
    from aero_viz.evaluation.bench.include import append_to_table
    from aero_viz.evaluation.score import load_trajectory
    from aero_viz.evaluation.score import score as score_flight

    limits, where = flight_rules(rules), place.load(world, seed=seed)
    result = score_flight(load_trajectory(flight, pose_topic=pose_topic), where, rules=limits, planner=planner)
    if table is not None:
        append_to_table(result, table)
    if json:
        print(json_module.dumps(result.to_dict(), allow_nan=False))
    else:
        print(result.format_table())


def world(
    action: tyro.conf.Positional[Literal["export"]],
    world: WorldName,
    output: OutputPath,
    *,
    spacing: float = 0.1,
    seed: int = 0,
    place: Inline[WorldFlags] = _WORLD,
) -> None:
    """Write a world to a file for other programs: its surface as points, or itself as JSON.

    Args:
        action: export.
        world: name of a scene, such as forest, a world's JSON file, a map of points or a mesh.
        output: .pcd, .ply or .npy for points, .json for the world.
        spacing: of the points [m].
        seed: of the scene.
        place: the world.
    """
    from aero_viz.evaluation.bench.surface import export_world

    points = export_world(place.load(world, seed=seed), output, spacing=spacing)
    print(f"{output}: {points} points" if points else str(output))


VERBS = (bench, score, world)
"""Functions that become verbs."""


@contextlib.contextmanager
def progress_bar() -> Iterator[Callable[[int, int, str], None]]:
    """A bar on stderr, on a terminal only."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}", markup=False))
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("")

        def update(over: int, total: int, text: str) -> None:
            bar.update(task, completed=over, total=total, description=text)

        yield update
