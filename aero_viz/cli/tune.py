"""The command `aero-viz tune`."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import tyro

from aero_planner.output_files import check_folder, check_output_files
from aero_planner.plain_text import say
from aero_planner.termination import is_terminating
from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    LidarName,
    OptionalFloat,
    OptionalInt,
    OptionalPath,
    OptionalText,
    RayFlag,
    WorldFlags,
    WorldName,
)
from aero_viz.cli.output import print_json, progress_bar
from aero_viz.cli.page import serve_flight
from aero_viz.cli.serving import PageFlags, StudyFlags
from aero_viz.errors import UserError

ObjectiveName = Literal["time", "clearance", "smoothness"]
_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_PAGE = PageFlags()
_WORLD = WorldFlags()


def tune(
    world: WorldName,
    *,
    over: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PATH[=LOW:HIGH]")] = (),
    objective: Annotated[tuple[ObjectiveName, ...], tyro.conf.UseAppendAction] = (),
    trials: int = 32,
    flights: int = 16,
    rungs: int = 3,
    generation: int = 16,
    sampler: Literal["auto", "tpe", "cmaes", "nsga2", "random"] = "auto",
    check: OptionalInt = None,
    storage: str = StudyFlags.storage,
    study: OptionalText = None,
    output: OptionalPath = None,
    overwrite: bool = False,
    speed: OptionalFloat = None,
    lidar: LidarName = "mid360",
    seed: int = 0,
    device: str = "cpu",
    batch: OptionalInt = None,
    ray: RayFlag = None,
    page: bool = False,
    json: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
    page_flags: Inline[PageFlags] = _PAGE,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Search for better parameter values by flying, and check them in fresh worlds.

    Optuna proposes candidates in generations. They and the incumbent, which is the given configuration, fly in the same
    worlds, which are divided into rungs. After each rung, candidates that are significantly worse than the best one are
    given up. Candidates are compared by the share of flights that arrive and, where that is equal, by the objective.
    Several objectives give a Pareto front. Finally, the best candidate and the incumbent fly in fresh worlds. Ctrl-C
    ends the search and keeps the best candidate so far. The same command continues the search.

    Args:
        world: Scene, with a different seed for each flight, or file of a world (JSON), point-cloud map or mesh.
        over: Parameter to tune, by default from a quarter of its value to four times its value; may be repeated.
        objective: What to improve besides arrivals, by default the time; may be repeated for a Pareto front.
        trials: Number of candidates. A study that has fewer is continued.
        flights: Number of worlds that a candidate flies in, unless it is given up.
        rungs: Number of groups into which the worlds are divided.
        generation: Number of candidates that are proposed at once.
        sampler: Algorithm of Optuna that proposes candidates; auto is TPE, or NSGA-II for several objectives.
        check: Flights of the best candidate and of the incumbent in fresh worlds; by default twice --flights.
        storage: Database of the studies, as a URL that Optuna understands, or memory to keep nothing.
        study: Name of the study; by default derived from all options, so that the same command continues it.
        output: YAML file to write, for --config.
        overwrite: Replace an existing file.
        speed: Speed limit [m/s]; overrides vehicle.speed_limit.
        lidar: LiDAR model of all drones.
        seed: First seed of the worlds, the LiDARs and all noise.
        device: Warp device, such as cpu or cuda:0.
        batch: Largest number of simultaneous flights; by default 256 on a GPU and 1 on the CPU.
        ray: Fly on all cores or GPUs of this machine with Ray, or on those of the cluster at ADDRESS.
        page: Show the study on the page: progress, Pareto front, importance. It stays until a second Ctrl-C or SIGTERM.
        json: Print one JSON object.
        world_flags: The world.
        page_flags: The page.
        flight_flags: The flight.
        config_flags: The planner's configuration, where the search starts.
    """
    from aero_planner.config.file import save_config
    from aero_viz.cli.study_page import StudyPage
    from aero_viz.evaluation.batching import check_count
    from aero_viz.evaluation.executor import open_executor
    from aero_viz.evaluation.tune import FlightOptions, SearchOptions, parse_ranges
    from aero_viz.evaluation.tune import tune as search_parameters
    from aero_viz.scenes import SCENES

    check_flights = 2 * flights if check is None else check
    if flights < 1 or check_flights < 1:
        raise UserError("--flights and --check must be at least 1.")
    check_count("--flights", flights)
    check_count("--check", check_flights)
    check_output_files(output, overwrite=overwrite, inputs=[world, config_flags.config])
    database, is_file = storage.removeprefix("sqlite:///").partition("?")[0], storage.startswith("sqlite:///")
    if is_file and storage != StudyFlags.storage and not database.startswith("file:"):
        check_folder(Path(database))  # only that of the default is created
    if not page:
        page_flags.refuse(advice="it is for the page: add --page, or leave it out")
    if page and storage == "memory":
        raise UserError("--page reads the study from its storage; leave out --storage memory.")
    config = config_flags.load(speed=speed)
    ranges = parse_ranges(over, config)
    fixed_world = None if world in SCENES else world_flags.load(world, seed=seed)
    worlds = [fixed_world or world_flags.load(world, seed=seed + i) for i in range(flights + check_flights)]
    options = flight_flags.options(config, lidar=lidar)
    with contextlib.ExitStack() as stack:
        executor = open_executor(ray, device=device)
        stack.callback(executor.close)
        shown = None
        if page:
            # The flight on the page is paused, because the search needs the cores.
            flags = (world, world_flags, flight_flags, config, dataclasses.replace(page_flags, paused=True))
            shown = StudyPage(partial(serve_flight, *flags, lidar=lidar, seed=seed, device=device))
            stack.callback(shown.close)
        try:
            with progress_bar() as update_bar:
                tuning = search_parameters(
                    config,
                    ranges,
                    worlds[:flights],
                    worlds[flights:],
                    search=SearchOptions(trials, generation, rungs, objective or ("time",), sampler, seed),
                    flight=FlightOptions(device=device, **options),
                    storage=None if storage == "memory" else storage,
                    study_name=study,
                    batch=batch,
                    executor=executor,
                    progress=lambda done, total, label: update_bar(done, total, f"{done}/{total} flights, {label}"),
                    opened=None if shown is None else lambda name: shown.open(StudyFlags(name, storage)),
                )
        except RuntimeError as error:
            raise UserError(f"The flights cannot run on {device}: {error}") from error
        if json:
            content = {"scene": world, "seed": seed, "device": device, "flights": flights, "storage": storage}
            content["simulation"] = {name: value and dataclasses.asdict(value) for name, value in options.items()}
            print_json({**content, **tuning.to_dict(), "config": tuning.chosen.to_dict()})
        else:
            changed = {path: value for path, value in tuning.values(tuning.chosen).items() if value != config.get(path)}
            as_flags = [f"--{path.replace('_', '-')} {value:g}" for path, value in changed.items()]
            say(tuning.format_table(), *([f"As flags: {' '.join(as_flags)}"] if as_flags else []), sep="\n")
            if storage != "memory" and shown is None:
                say(f"On the page: aero-viz demo {world} --study {tuning.study} --storage {storage}")
        if output is not None and tuning.best is not None:
            save_config(tuning.chosen, output)
            if not json:
                say(output)
        if shown is not None and not is_terminating():
            sys.stdout.flush()
            shown.wait()
    if tuning.interrupted:
        raise SystemExit(130)
