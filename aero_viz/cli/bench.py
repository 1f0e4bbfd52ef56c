"""The command `aero-viz bench`."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from aero_planner.plain_text import say
from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    LidarName,
    OptionalFloat,
    OptionalInt,
    OptionalPath,
    OptionalPoint,
    RayFlag,
    flight_rules,
)
from aero_viz.cli.missions import WaypointTexts, chosen_mission, fly_through
from aero_viz.cli.output import print_json, print_report, progress_bar
from aero_viz.errors import UserError
from aero_viz.text_table import format_table

if TYPE_CHECKING:
    from aero_viz.evaluation.bench.external_results import ExternalResults
    from aero_viz.evaluation.bench.suites import Benchmark


@dataclasses.dataclass(frozen=True)
class RunFlags:
    """The run."""

    device: str = "cpu"
    """Warp device, such as cpu or cuda:0."""
    seed: int = 0
    """First seed of the worlds, LiDARs and planners."""
    lidar: Annotated[LidarName | None, tyro.conf.arg(help_behavior_hint="")] = None
    """LiDAR model of all rows; by default each row has its own."""
    batch: OptionalInt = None
    """Largest number of simultaneous flights; by default 256 on a GPU and 1 on the CPU."""
    output: OptionalPath = None
    """Folder of the results; by default results/NAME."""
    resume: bool = False
    """Continue with the results in the folder."""
    examine: bool = True
    """Search a path through every world and measure its difficulty, about 1 s of CPU time per world."""
    ray: RayFlag = None
    """Fly on all cores or GPUs of this machine with Ray, or on those of the cluster at ADDRESS."""
    causes: bool = True
    """Fly each failure again, alone, and explain it."""
    json: bool = False
    """Print one JSON object."""
    flight: Inline[FlightFlags] = dataclasses.field(default_factory=FlightFlags)


_CONFIG = ConfigFlags()
_RUN = RunFlags()


def bench(
    name: tyro.conf.Positional[
        Literal["table2", "success", "density", "rooms", "ablation", "default", "sudden", "moving", "scaling"]
    ],
    *,
    flights: int = 50,
    include: tuple[str, ...] = (),
    run_flags: Inline[RunFlags] = _RUN,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a benchmark and write its tables, plots and report.

    table2: the paper's three scenes at 7 m/s. success: speed limits from 1 to 7 m/s. density: 200 to 1000 obstacles.
    rooms: four indoor rooms. ablation: each mechanism switched off alone. default: acceptance test of the default
    configuration. sudden: an object that appears in front of the drone. moving: 20 to 60 pillars that move. scaling:
    flights per minute for several batch sizes. Ctrl-C keeps the finished flights; --resume continues.

    Args:
        name: Name of the benchmark.
        flights: Number of worlds per row. A row of scaling has as many flights as its batch, in these worlds.
        include: Flights of other planners, each NAME=TABLE.csv (from `score --table`) or NAME=FLIGHT@WORLD.json.
        run_flags: The run.
        config_flags: The planner and its configuration.
    """
    from aero_viz.evaluation.bench.external_results import load_external_results
    from aero_viz.evaluation.bench.suites import BENCHMARKS

    benchmark = BENCHMARKS[name]
    first = run_flags.seed + benchmark.first_seed
    external = load_external_results(include, benchmark, seeds=range(first, first + flights))
    _run(benchmark, run_flags, config_flags, flights=flights, external=external)


def bench_worlds(
    folder: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FOLDER")]],
    *,
    flights: int = 1,
    speed: float = 7.0,
    start: OptionalPoint = None,
    goal: OptionalPoint = None,
    waypoint: WaypointTexts = (),
    mission: OptionalPath = None,
    voxel: OptionalFloat = None,
    run_flags: Inline[RunFlags] = _RUN,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly through all worlds in a folder and write a report.

    Worlds are JSON files, Gazebo worlds, point-cloud maps, meshes and occupancy images. Those in JSON have their own
    start and goal, and others are flown across their longest side. The report has a line per world, and the success in
    the easiest, middle and hardest third. Ctrl-C keeps the finished flights; --resume continues.

    Args:
        folder: Folder of the worlds.
        flights: Number of flights through each world, with different noise.
        speed: Speed limit [m/s].
        start: Start position x y z [m] in all worlds.
        goal: Goal position x y z [m] in all worlds.
        waypoint: Waypoint in all worlds, see `fly`; may be repeated.
        mission: YAML file of waypoints in all worlds.
        voxel: Voxel size for point-cloud maps, and pixel size for images [m].
        run_flags: The run.
        config_flags: The planner and its configuration.
    """
    from aero_viz.evaluation.bench.world_folder import folder_benchmark

    if run_flags.output is not None and run_flags.output.resolve() == folder.resolve():
        raise UserError(f"{folder} is the folder of the worlds, which a report could replace; choose another --output.")
    route = chosen_mission(waypoint, mission, goal=goal)
    goal = goal if route is None else route.goal
    benchmark = folder_benchmark(folder, speed=speed, start=start, goal=goal, voxel=voxel)
    if route is not None:
        worlds = {name: fly_through(world, route) for name, world in benchmark.worlds.items()}
        benchmark = dataclasses.replace(benchmark, worlds=worlds)
    _run(benchmark, run_flags, config_flags, flights=flights, external=())


def _run(
    benchmark: Benchmark,
    flags: RunFlags,
    config_flags: ConfigFlags,
    *,
    flights: int,
    external: Sequence[ExternalResults],
) -> None:
    """Fly a benchmark, write its report and print the summary."""
    from aero_viz.evaluation.bench.causes import cause_rows
    from aero_viz.evaluation.bench.difficulty_groups import format_groups
    from aero_viz.evaluation.bench.report import (
        format_causes,
        format_summaries,
        format_worlds,
        world_records,
        write_report,
    )
    from aero_viz.evaluation.bench.runner import BenchmarkInterrupted, run_benchmark
    from aero_viz.evaluation.bench.success_matrix import format_matrix
    from aero_viz.evaluation.executor import open_executor

    folder, config = flags.output or Path("results") / benchmark.name, config_flags.load()
    executor, interrupted = open_executor(flags.ray, device=flags.device), False
    try:
        with progress_bar() as update_bar:
            run = run_benchmark(
                benchmark,
                folder,
                flights=flights,
                seed=flags.seed,
                config=config,
                config_name=config_flags.name_of(config),
                device=flags.device,
                lidar=flags.lidar,
                batch=flags.batch,
                resume=flags.resume,
                rules=flight_rules(flags.flight.rules),
                noise=flags.flight.state_noise(),
                drone=flags.flight.drone_changes,
                sensor=flags.flight.lidar_changes,
                examine=flags.examine,
                executor=executor,
                causes=flags.causes,
                progress=lambda done, total, label: update_bar(done, total, f"{done}/{total} flights, {label}"),
            )
    except BenchmarkInterrupted as interruption:
        run, interrupted = interruption.run, True
    except RuntimeError as error:
        raise UserError(f"The benchmark cannot run on {flags.device}: {error}") from error
    finally:
        executor.close()
    summaries = write_report(run, folder, external=external)
    if interrupted:
        say(
            f"{len(run.flights)} of {run.total} flights are kept in {folder}; "
            "run the same command with --resume to continue.",
            file=sys.stderr,
        )
    if flags.json:
        summary = [line.to_dict() for line in summaries]
        print_json(
            {
                **run.header,
                "output": str(folder),
                "summary": summary,
                "worlds": world_records(run),
                "causes": cause_rows(run.flights),
                "interrupted": interrupted,
            }
        )
    elif not interrupted:
        groups = format_groups(run)
        matrix = format_matrix(run)
        success = format_table(matrix[1:], header=matrix[0]) if matrix else ""
        thirds = format_table(groups[1:], header=groups[0]) if groups else ""
        tables = [success, format_summaries(summaries), format_causes(run), *format_worlds(run), thirds]
        say(*filter(None, tables), folder / "report.md", sep="\n")
    if interrupted:
        raise SystemExit(130)


def bench_compare(
    a: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="A")]],
    b: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="B")]],
    *,
    json: bool = False,
) -> None:
    """Compare runs of a benchmark through the same worlds.

    Two runs are compared world by world, and more than two, such as those of several planners, side by side. A sign
    test over the worlds says whether a difference is significant. The runs may differ in the planner, the configuration
    and the versions of the packages. Fly each with its own --output.

    Args:
        a: Folder of the results of the first run.
        b: Folder of the results of the second run, and of further ones.
        json: Print one JSON object.
    """
    from aero_viz.evaluation.bench.comparison import compare_runs
    from aero_viz.evaluation.bench.side_by_side import compare_side_by_side

    if not b:
        raise UserError("There is one run only; give the folders of two or more.")
    print_report(compare_runs(a, b[0]) if len(b) == 1 else compare_side_by_side((a, *b)), as_json=json)
