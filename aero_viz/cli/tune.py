"""The verb `aero-viz tune`: better parameters by flying."""

from __future__ import annotations

import dataclasses
import json as json_module
from pathlib import Path
from typing import Annotated, Literal

import tyro

from aero_viz.cli.bench import progress_bar
from aero_viz.cli.flags import ConfigFlags, FlightFlags, Inline, WorldFlags, WorldName
from aero_viz.errors import UserError

__all__ = ["tune"]

_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_WORLD = WorldFlags()


def tune(
    world: WorldName,
    *,
    over: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="PATH[=LOW:HIGH]")] = (),
    flights: int = 16,
    rounds: int = 4,
    check: int | None = None,
    output: Path | None = None,
    overwrite: bool = False,
    speed: float | None = None,
    lidar: Literal["mid360", "full-sphere", "spinning64"] = "mid360",
    seed: int = 0,
    device: str = "cpu",
    batch: int | None = None,
    json: bool = False,
    place: Inline[WorldFlags] = _WORLD,
    flight: Inline[FlightFlags] = _FLIGHT,
    flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Find better values of planner parameters by flying, and check them in fresh worlds.

    The incumbent, which is the configuration as it is, and 2^rounds candidates fly the same worlds. After each round
    the better half stays: what counts is the share of flights that arrive and, where that is equal, the mean time of
    those that do. The best and the incumbent then fly fresh worlds. Ctrl-C ends it and keeps the best so far.

    Args:
        world: name of a scene, of which every flight has another seed, a world's JSON file, a map of points or a mesh.
        over: what to tune, such as costs.q_track, from a quarter of its value to four times it, or costs.q_track=1:20.
        flights: of a candidate that stays to the end, dealt out over the rounds.
        rounds: 4 start with 16 candidates, 6 with 64.
        check: flights of the best, and as many of the incumbent, in fresh worlds; twice --flights when left out.
        output: YAML file to write, for --config.
        overwrite: replace the file if it exists.
        speed: speed limit [m/s]; replaces vehicle.speed_limit.
        lidar: of all drones.
        seed: first seed of worlds, LiDARs and all noise.
        device: Warp device, such as cpu or cuda:0.
        batch: flights at once at most; 256 on a GPU and 1 on the CPU when left out.
        json: print one JSON object.
        place: the world.
        flight: the flight.
        flags: the planner's configuration, where the search begins.
    """
    from aero_planner.config.file import save_config
    from aero_viz.evaluation.tune import parse_spans
    from aero_viz.evaluation.tune import tune as search
    from aero_viz.scenes import SCENES

    later = 2 * flights if check is None else check
    if flights < 1 or later < 1:
        raise UserError("--flights and --check must be at least 1.")
    if output is not None:
        _refuse_place(output, overwrite=overwrite)
    config = flags.load(place.ground(world, seed=seed))
    config = config if speed is None else config.replace({"vehicle.speed_limit": speed})
    spans = parse_spans(over, config)
    one = None if world in SCENES else place.load(world, seed=seed)
    worlds = [one or place.load(world, seed=seed + i) for i in range(flights + later)]
    options = flight.options(config, lidar=lidar)
    try:
        with progress_bar() as progress:
            tuning = search(
                config,
                spans,
                worlds[:flights],
                worlds[flights:],
                rounds=rounds,
                seed=seed,
                device=device,
                batch=batch,
                progress=progress,
                **options,
            )
    except RuntimeError as error:
        raise UserError(f"The flights cannot run on {device}: {error}") from error
    if json:
        about = {"scene": world, "seed": seed, "device": device, "flights": flights, "rounds": rounds}
        about["simulation"] = {name: value and dataclasses.asdict(value) for name, value in options.items()}
        print(json_module.dumps({**about, **tuning.to_dict(), "config": tuning.chosen.to_dict()}, allow_nan=False))
    else:
        changed = {path: value for path, value in tuning.values(tuning.chosen).items() if value != config.get(path)}
        given = [f"--{path.replace('_', '-')} {value:g}" for path, value in changed.items()]
        print(tuning.format_table(), *([f"As flags: {' '.join(given)}"] if given else []), sep="\n")
    if output is not None and tuning.compared:
        save_config(tuning.chosen, output)
        if not json:
            print(output)
    if tuning.interrupted:
        raise SystemExit(130)


def _refuse_place(output: Path, *, overwrite: bool) -> None:
    """Refuse before hours of flying what could not be written after them."""
    if output.is_dir():
        raise UserError(f"{output} is a folder; give --output the name of a file.")
    if output.exists() and not overwrite:
        raise UserError(f"{output} exists already; add --overwrite to replace it, or choose another --output.")
    if not output.absolute().parent.is_dir():
        raise UserError(f"The folder {output.parent} does not exist; make it, or choose another --output.")
