"""The commands `aero-viz snapshot`, `world`, `export`, `parameters` and `doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from aero_planner.output_files import check_ending, check_output_files
from aero_planner.plain_text import say
from aero_viz.cli.flags import (
    AERO_MPPI,
    ConfigFlags,
    Inline,
    OptionalFloat,
    OptionalPath,
    OptionalText,
    OutputPath,
    PlannerName,
    WorldFlags,
    WorldName,
)
from aero_viz.cli.output import print_report
from aero_viz.errors import UserError
from aero_viz.planners.registry import config_type

_CONFIG = ConfigFlags()
_WORLD = WorldFlags()


def snapshot(
    source: WorldName,
    output: OutputPath,
    *,
    time: float = 2.0,
    camera: str = "follow",
    layers: OptionalText = None,
    legend: bool = False,
    light: bool = False,
    size: tuple[int, int] = (1600, 1000),
    seed: int = 0,
    device: str = "cpu",
    points_topic: OptionalText = None,
    pose_topic: OptionalText = None,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Render a scene or a recording at a given time to a PNG file.

    The page is rendered in a headless Chromium.

    Args:
        source: Scene, world file (JSON) or recording.
        output: PNG file to write; an existing one is replaced.
        time: Time in the source [s].
        camera: follow, top or side; or position and look-at point as six numbers, such as 0,-8,4,3,0,2 [m].
        layers: Layers to show, separated by commas, such as rollouts,drone; by default those of the page.
        legend: Explain the colours in a corner of the picture.
        light: Draw the scene on white, for paper.
        size: Width and height [pixels].
        seed: Seed of the scene, the LiDAR and the planner's noise.
        device: Warp device of planner and simulation.
        points_topic: Topic of the point clouds; by default it is found by its type.
        pose_topic: Topic of the poses; by default it is found by its type.
        config_flags: The planner's configuration.
    """
    from aero_viz.catalog import open_source
    from aero_viz.dashboard.snapshot import snapshot as take_snapshot
    from aero_viz.flight.known_drone import config_for_flight

    check_output_files(derived=[output], overwrite=True, inputs=[source, config_flags.config])
    config = config_flags.load()
    opened = open_source(source, seed=seed, device=device, points_topic=points_topic, pose_topic=pose_topic)
    take_snapshot(
        opened,
        time=time,
        config=config_for_flight(config, opened.info),
        camera=_viewpoint(camera),
        layers=None if layers is None else [name.strip() for name in layers.split(",")],
        legend=legend,
        light=light,
        size=size,
        path=output,
        seed=seed,
        device=device,
    )
    say(output)


def _viewpoint(camera: str) -> str | tuple[list[float], list[float]]:
    """Return the name of a view, or a position and a look-at point."""
    words = camera.replace(",", " ").split()
    if len(words) != 6:
        return camera
    try:
        numbers = [float(word) for word in words]
    except ValueError as error:
        raise UserError(f"The camera {camera!r} is not six numbers; give such as 0,-8,4,3,0,2.") from error
    return numbers[:3], numbers[3:]


def world_export(
    world: WorldName,
    output: OutputPath,
    *,
    spacing: float = 0.1,
    fit: OptionalFloat = None,
    picture: OptionalPath = None,
    overwrite: bool = False,
    seed: int = 0,
    world_flags: Inline[WorldFlags] = _WORLD,
) -> None:
    """Write a world to a file for other programs.

    A point cloud becomes a world of its voxels or, with --fit, of ground and slopes, trunks, walls, and a mesh of the
    rest; what was found and how well it fits is printed.

    Args:
        world: Scene, such as forest, or file of a world (JSON), point-cloud map or mesh, or a bag of one cloud.
        output: .pcd, .ply or .npy file for points on the world's surfaces, or .json file for the world itself.
        spacing: Spacing of the points [m].
        fit: Fit solids to a cloud within this tolerance [m], about three times its noise.
        picture: PNG file of the cloud and of the solids that were fitted, from above and from the side.
        overwrite: Replace an existing file.
        seed: Seed of the scene.
        world_flags: The world.
    """
    from aero_viz.evaluation.world_export import export_world

    check_output_files(output, overwrite=overwrite, derived=[picture], inputs=[world])
    check_ending(picture, ".png", "a picture")
    if fit is not None:
        text = _fit_world(world, output, world_flags, tolerance=fit, spacing=spacing, picture=picture)
        say(f"{output}: {text}")
        return
    if picture is not None:
        raise UserError("The picture shows how solids fit a cloud: add --fit 0.1, or leave --picture out.")
    points = export_world(world_flags.load(world, seed=seed), output, spacing=spacing)
    say(f"{output}: {points} points" if points else str(output))


def _fit_world(
    cloud: str, output: Path, flags: WorldFlags, *, tolerance: float, spacing: float, picture: Path | None
) -> str:
    """Write the world of solids that fit a cloud; return what was found."""
    from aero_viz.catalog import read_cloud
    from aero_viz.evaluation.fit_picture import draw_fit
    from aero_viz.evaluation.world_export import export_world
    from aero_viz.scenes.from_cloud import fit_world

    if flags.count is not None or flags.voxel is not None:
        raise UserError(
            "Solids that are fitted to a cloud have neither a number nor voxels; leave --count and --voxel out."
        )
    if flags.route() is not None:
        raise UserError("Solids are fitted without waypoints; leave --waypoint and --mission out.")
    points = read_cloud(cloud)
    fitted = fit_world(points, cloud, tolerance=tolerance, start=flags.start, goal=flags.goal)
    export_world(fitted.world, output, spacing=spacing)
    if picture is not None:
        draw_fit(fitted, picture)
    return fitted.describe()


def world_info(
    world: WorldName,
    *,
    seed: int = 0,
    radius: float = 0.25,
    json: bool = False,
    world_flags: Inline[WorldFlags] = _WORLD,
) -> None:
    """Describe a world: its obstacles, whether a path exists, and how difficult it is.

    The difficulty is that of FlightBench (Yu et al. 2024): traversability obstruction, view occlusion and angle over
    length along a short path from start to goal. docs/benchmarks.md defines them.

    Args:
        world: Scene, such as forest, or file of a world (JSON, Gazebo), point-cloud map, mesh or occupancy image.
        seed: Seed of the scene.
        radius: Radius of the drone [m].
        json: Print one JSON object.
        world_flags: The world.
    """
    from aero_viz.evaluation.world_info import examine_world

    print_report(examine_world(world_flags.load(world, seed=seed), radius=radius), as_json=json)


def export(
    output: Annotated[OutputPath, tyro.conf.arg(metavar="OUT[.tar]")],
    *,
    config: str = "default",
    arch: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="sm_87")] = (),
    cpu: bool = False,
    overwrite: bool = False,
) -> None:
    """Compile all kernels ahead of time for a drone that has no compiler.

    This is the same as `aero-planner export`. No GPU is needed. Where this machine itself has one of the requested
    processors, the bundle also contains the graph for the C++ host.

    Args:
        output: Folder or tar file to write.
        config: Preset or YAML file; the file may contain the node's settings under 'onboard:'.
        arch: GPU architecture; may be repeated.
        cpu: Compile for this machine's CPU, too.
        overwrite: Replace an existing tar file.
    """
    from aero_planner.cli import write_bundle

    try:
        summary = write_bundle(output, config=config, architectures=arch, cpu=cpu, overwrite=overwrite)
    except OSError as error:
        raise UserError(f"{output} can't be written: {error.strerror or error}.") from error
    say(summary)


def parameters(*, planner: PlannerName = AERO_MPPI) -> None:
    """Print a Markdown table of every planner parameter.

    The table has symbol, default, range, unit and meaning.

    Args:
        planner: Planner, as for `fly`.
    """
    from aero_planner.config.docs import format_parameters

    say(format_parameters(config_type(planner)))


def doctor(*, json: bool = False) -> None:
    """Check this machine and print how to install what is missing.

    It checks the versions of libraries, plans once on every device, and looks for a browser. The exit code is 2 when
    something required is missing.

    Args:
        json: Print one JSON object.
    """
    from aero_viz.cli.doctor import examine

    report = examine()
    print_report(report, as_json=json)
    if not report.passed:
        raise SystemExit(2)
