"""The verb `aero-viz bench`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    OptionalInt,
    OptionalPath,
    RayFlag,
    flight_rules,
)
from aero_viz.cli.output import print_json, print_report, progress_bar
from aero_viz.errors import UserError

__all__ = ["bench", "bench_compare"]

_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()


def bench(
    name: tyro.conf.Positional[Literal["table2", "success", "density", "rooms", "ablation", "default", "scaling"]],
    *,
    device: str = "cpu",
    flights: int = 50,
    seed: int = 0,
    lidar: Literal["mid360", "full-sphere", "spinning64"] | None = None,
    batch: OptionalInt = None,
    output: OptionalPath = None,
    resume: bool = False,
    include: tuple[str, ...] = (),
    ray: RayFlag = None,
    causes: bool = True,
    json: bool = False,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Fly a benchmark and write its tables, plots and report.

    table2: the paper's three scenes at 7 m/s. success: speed limits from 1 to 7 m/s. density: 200 to 1000 obstacles.
    rooms: four indoor rooms. ablation: each mechanism switched off alone. default: acceptance test of the default
    configuration. scaling: flights per minute for several batch sizes. Ctrl-C keeps the finished flights; --resume
    continues.

    Args:
        name: Name of the benchmark.
        device: Warp device, such as cpu or cuda:0.
        flights: Number of worlds per row.
        seed: First seed of the worlds, LiDARs and planners.
        lidar: LiDAR model of all rows; by default each row has its own.
        batch: Largest number of simultaneous flights; by default 256 on a GPU and 1 on the CPU.
        output: Folder of the results; by default results/NAME.
        resume: Continue with the results in the folder.
        include: Flights of other planners, each NAME=TABLE.csv (from `score --table`) or NAME=FLIGHT@WORLD.json.
        ray: Fly on all cores or GPUs of this machine with Ray, or on those of the cluster at ADDRESS.
        causes: Fly each failure once more, alone, and explain it.
        json: Print one JSON object.
        flight_flags: The flight.
        config_flags: The planner's configuration.
    """
    from aero_planner.config.file import config_from_name
    from aero_viz.evaluation.bench.causes import cause_rows
    from aero_viz.evaluation.bench.external_results import load_external_results
    from aero_viz.evaluation.bench.report import (
        format_causes,
        format_summaries,
        format_worlds,
        world_records,
        write_report,
    )
    from aero_viz.evaluation.bench.runner import BenchmarkInterrupted, run_benchmark
    from aero_viz.evaluation.bench.suites import BENCHMARKS
    from aero_viz.evaluation.executor import open_executor

    benchmark, folder, config = BENCHMARKS[name], output or Path("results") / name, config_flags.load()
    is_changed = config != config_from_name(config_flags.config)
    external = load_external_results(include, benchmark)
    executor = open_executor(ray, device=device)
    try:
        with progress_bar() as update_bar:
            run = run_benchmark(
                benchmark,
                folder,
                flights=flights,
                seed=seed,
                config=config,
                config_name=f"{config_flags.config}, changed" if is_changed else config_flags.config,
                device=device,
                lidar=lidar,
                batch=batch,
                resume=resume,
                rules=flight_rules(flight_flags.rules),
                noise=flight_flags.state_noise(),
                drone=flight_flags.drone_changes,
                sensor=flight_flags.lidar_changes,
                executor=executor,
                causes=causes,
                progress=lambda done, total, label: update_bar(done, total, f"{done}/{total} flights, {label}"),
            )
        summaries = write_report(run, folder, external=external)
    except BenchmarkInterrupted as interrupted:
        run = interrupted.run
        write_report(run, folder, external=external)
        print(
            f"{len(run.flights)} of {run.total} flights are kept in {folder}; "
            "run the same command with --resume to continue.",
            file=sys.stderr,
        )
        raise SystemExit(130) from None
    except RuntimeError as error:
        raise UserError(f"The benchmark cannot run on {device}: {error}") from error
    finally:
        executor.close()
    if json:
        summary = [line.to_dict() for line in summaries]
        print_json(
            {
                **run.header,
                "output": str(folder),
                "summary": summary,
                "worlds": world_records(run),
                "causes": cause_rows(run.flights),
            }
        )
    else:
        tables = [format_summaries(summaries), format_causes(run), *format_worlds(run)]
        print(*filter(None, tables), folder / "report.md", sep="\n")


def bench_compare(
    a: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="A")]],
    b: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="B")]],
    *,
    json: bool = False,
) -> None:
    """Compare two runs of a benchmark through the same worlds.

    A sign test over the worlds says whether the difference is significant. The runs may differ in the configuration and
    in the versions of the packages. Fly each with its own --output.

    Args:
        a: Folder of the results of the first run.
        b: Folder of the results of the second run.
        json: Print one JSON object.
    """
    from aero_viz.evaluation.bench.comparison import compare_runs

    print_report(compare_runs(a, b), as_json=json)
