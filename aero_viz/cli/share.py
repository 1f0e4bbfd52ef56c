"""The command `aero-viz share`."""

from __future__ import annotations

import contextlib
import shlex
import sys
from pathlib import Path

from aero_planner.output_files import check_output_files
from aero_planner.plain_text import say
from aero_viz.cli.flags import (
    ConfigFlags,
    FlightFlags,
    Inline,
    LidarName,
    OptionalFloat,
    OptionalText,
    OutputPath,
    WorldFlags,
    WorldName,
)
from aero_viz.cli.output import progress_bar
from aero_viz.errors import UserError
from aero_viz.text_table import format_size

_CONFIG = ConfigFlags()
_FLIGHT = FlightFlags()
_WORLD = WorldFlags()


def share(
    source: WorldName,
    output: OutputPath,
    *,
    speed: OptionalFloat = None,
    duration: float = 60.0,
    layers: OptionalText = None,
    overwrite: bool = False,
    lidar: LidarName = "mid360",
    seed: int = 0,
    device: str = "cpu",
    world_flags: Inline[WorldFlags] = _WORLD,
    flight_flags: Inline[FlightFlags] = _FLIGHT,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Write a flight to one file: page, video, picture or log.

    The extension of the file determines which: .html, .mp4, .png or .mcap. The page needs no server and no network: any
    browser opens it from disk, plays it, and seeks to any time.

    Args:
        source: Scene, file of a world (JSON), point-cloud map or mesh, recording, or flight log.
        output: File to write; its extension determines the format.
        speed: Speed limit [m/s]; overrides vehicle.speed_limit.
        duration: Longest time to show [s].
        layers: Layers to show, separated by commas, such as rollouts,drone,obstacles; by default those of the page.
        overwrite: Replace an existing file.
        lidar: LiDAR model of a flight.
        seed: Seed of the scene, the LiDAR and all noise.
        device: Warp device of planner and simulation.
        world_flags: The world.
        flight_flags: The flight.
        config_flags: The planner's configuration.
    """
    from aero_viz.catalog import is_recording, open_source
    from aero_viz.cli.page import flight_opener
    from aero_viz.dashboard.share import share as write
    from aero_viz.dashboard.share.share import check_path
    from aero_viz.flight.known_drone import config_for_flight

    check_output_files(output, overwrite=True, inputs=[source, config_flags.config, *_recorded_files(source, output)])
    check_path(output, overwrite=overwrite)
    config = config_flags.load(speed=speed)
    if is_recording(source):
        if (world_flags, flight_flags, lidar) != (_WORLD, _FLIGHT, "mid360"):
            raise UserError(f"{source} is a recording: leave out the flags of the world, the LiDAR and the flight.")
        flight = open_source(source, seed=seed, device=device)
    else:
        opener = flight_opener(source, world_flags, flight_flags, config, lidar=lidar, device=device)
        flight = opener(source, seed=seed)
    with progress_bar(flight.info.name, enabled=True) as update_bar:
        write(
            flight,
            output,
            command=_command(source, output, closed_loop=flight.info.closed_loop),
            config=config_for_flight(config, flight.info),
            seed=seed,
            device=device,
            duration=duration,
            layers=None if layers is None else [name.strip() for name in layers.split(",")],
            report=lambda time: update_bar(min(time, duration), duration, f"{time:.1f} s"),
        )
    say(f"{output}: {format_size(output.stat().st_size)}")


def _recorded_files(source: str, output: Path) -> list[Path]:
    """Return the files of a recording that is a folder; empty where there is nothing to write over."""
    from aero_viz.recordings.storage import open_storage

    if not output.exists() or not Path(source).is_dir():
        return []
    with contextlib.closing(open_storage(source)) as storage:
        return [file.path for file in storage.files]


def _command(source: str, output: Path, *, closed_loop: bool) -> str:
    """Return the command that shows the flight live: the present one without the output and its flags."""
    flags, words = [], iter(sys.argv[2:])
    for word in words:
        if word in ("--duration", "--layers"):
            next(words, None)
            continue
        is_of_file = word.startswith(("--duration=", "--layers=", "--overwrite", "--no-overwrite"))
        if word != source and Path(word) != output and not is_of_file:
            flags.append(word)
    return shlex.join(["aero-viz", "demo" if closed_loop else "play", source, *flags])
