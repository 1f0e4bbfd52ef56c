"""The command line on the drone: `aero-planner run`, `preflight`, `export`, `config`, and commands of other packages.

A package adds a command by an entry point in the group "aero_planner.commands". The name of the entry point is that of
the command. Its value is a function that takes the arguments after the name and returns an exit code or None.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aero_planner.cli_util import INTERRUPTED, Parser, abandon_output, installed_version, quick_imports
from aero_planner.plain_text import in_own_words, one_line, say
from aero_planner.termination import install_handler

if TYPE_CHECKING:
    from aero_planner.config import PlannerConfig
    from aero_planner.deploy.bundle import Bundle
    from aero_planner.onboard.px4_parameters import ParameterChange
    from aero_planner.onboard.settings import OnboardConfig

GROUP = "aero_planner.commands"
"""Group of the entry points that add commands."""

_COMMANDS = ("run", "preflight", "export", "config")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 0 on success, 2 for a user error or a failed check, 130 after Ctrl-C or SIGTERM."""
    install_handler()
    try:
        # Imported here so that Ctrl-C during the import also ends the program quietly.
        from importlib.metadata import entry_points

        from aero_planner.parameters import did_you_mean

        words = list(sys.argv[1:] if arguments is None else arguments)
        added = {point.name: point for point in entry_points(group=GROUP) if point.name not in _COMMANDS}
        commands = [*_COMMANDS, *sorted(added)]
        if words and words[0] in added:
            return int(added[words[0]].load()(words[1:]) or 0)
        if words and not words[0].startswith("-") and words[0] not in commands:
            raise ValueError(
                f"there is no command {words[0]!r}{did_you_mean(words[0], commands)}; commands: {', '.join(commands)}."
            )
        parser = make_parser(sorted(added))
        options = parser.parse_args(words)
        if options.command is None:
            parser.print_help()
            return 2
        if arguments is None and options.module is not None:
            with quick_imports():
                importlib.import_module(options.module)
        code = options.call(options)
        sys.stdout.flush()
        return code
    except (ValueError, ImportError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            return abandon_output()
        if os.environ.get("AERO_PLANNER_DEBUG"):
            raise
        text = in_own_words(error) if isinstance(error, ValueError) else str(error)
        say(f"aero-planner: {one_line(text)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def make_parser(added_commands: Sequence[str]) -> argparse.ArgumentParser:
    epilog = f"Commands of other packages: {', '.join(added_commands)}." if added_commands else None
    parser = Parser(prog="aero-planner", description="Fly with the AERO-MPPI planner.", epilog=epilog)
    parser.add_argument("--version", action="version", version=f"aero-planner {installed_version('aero-planner')}")
    parser.set_defaults(module=None)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")

    files = Parser(add_help=False)
    files.add_argument(
        "--config",
        help="preset, or YAML file saved from the dashboard; it may contain the node's settings under 'onboard:'",
    )
    files.add_argument(
        "--onboard", metavar="FILE", help="YAML file with the node's settings, if they are not in --config"
    )
    flight = Parser(add_help=False, parents=[files])
    flight.add_argument(
        "--goal", nargs=3, type=float, metavar=("X", "Y", "Z"), help="goal position: north, west, up [m]"
    )
    flight.add_argument("--device", default="cpu", help="device of the planner: cpu or cuda:0 (default: cpu)")
    flight.add_argument(
        "--bundle",
        metavar="PATH",
        help="bundle whose kernels are used instead of a compiler, and whose configuration is used without --config",
    )
    flight.add_argument(
        "--log", type=Path, metavar="PATH",
        help="file to write, which ends in .mcap, or folder, which is created, for a file named after the date",
    )  # fmt: skip

    run = commands.add_parser(
        "run", parents=[flight], help="fly when the pilot switches to OFFBOARD", description=_run.__doc__
    )
    run.add_argument("--seed", type=int, default=0, help="seed of the planner's noise (default: 0)")
    run.add_argument("--threads", type=int, help="CPU threads of the planner (default: one per usable core)")
    run.add_argument("--json", action="store_true", help="print statistics as one JSON object at the end")
    run.set_defaults(call=_run, module="aero_planner.onboard.run")

    preflight = commands.add_parser(
        "preflight", parents=[flight], help="check that everything is ready to fly", description=_preflight.__doc__
    )
    preflight.add_argument(
        "--listen", type=float, default=3.0, help="time to listen to sensor and autopilot [s] (default: 3)"
    )
    preflight.add_argument("--json", action="store_true", help="print one JSON object")
    preflight.add_argument(
        "--set", action="store_true", help="offer to write the PX4 parameters that should have other values"
    )
    preflight.set_defaults(call=_preflight, module="aero_planner.onboard.preflight")

    export = commands.add_parser("export", help="compile for a drone that has no compiler", description=_export.__doc__)
    export.add_argument("out", metavar="OUT[.tar]", help="folder or tar file to write")
    export.add_argument(
        "--config", default="default", help="preset or YAML file; it may contain the node's settings under 'onboard:'"
    )
    export.add_argument(
        "--arch", action="append", default=[], metavar="sm_87", help="GPU architecture; may be repeated"
    )
    export.add_argument("--cpu", action="store_true", help="compile for this machine's CPU")
    export.add_argument("--overwrite", action="store_true", help="replace an existing tar file")
    export.set_defaults(call=_export)

    config = commands.add_parser("config", help="show or validate a configuration")
    actions = config.add_subparsers(dest="action", required=True, metavar="ACTION")
    show = actions.add_parser("show", parents=[files], help="print every parameter in the form of a YAML file")
    show.set_defaults(call=_show)
    validate = actions.add_parser("validate", help="check a file")
    validate.add_argument("file", help="YAML file with planner parameters, settings of the node, or both; or preset")
    validate.set_defaults(call=_validate)
    return parser


def _open_bundle(options: argparse.Namespace, stack: contextlib.ExitStack) -> Bundle | None:
    """Open the bundle of the options until the stack unwinds; its configuration becomes the default of --config."""
    if options.bundle is None:
        return None
    from aero_planner.deploy.bundle import open_bundle

    bundle = stack.enter_context(open_bundle(options.bundle))
    options.config = options.config or str(bundle.config_file)
    return bundle


def _load_configs(options: argparse.Namespace) -> tuple[PlannerConfig, OnboardConfig]:
    from aero_planner.onboard.flight_config import load_checked

    return load_checked(options.config or "default", options.onboard)


def _show(options: argparse.Namespace) -> int:
    from aero_planner.config.file import format_config
    from aero_planner.onboard.flight_config import format_onboard

    planner, onboard = _load_configs(options)
    say(f"{format_config(planner)}\n{format_onboard(onboard)}", end="")
    return 0


def _validate(options: argparse.Namespace) -> int:
    from aero_planner.onboard.flight_config import load_any_checked

    load_any_checked(options.file)
    say(f"{options.file} is valid")
    return 0


def _preflight(options: argparse.Namespace) -> int:
    """Check versions, device, ports, sensor, autopilot, its parameters, thrust and disk. Exit code 0 or 2.

    Commands nothing. With --set, parameters of the autopilot are written after a question.
    """
    from aero_planner.onboard.preflight import preflight

    if not 0.1 <= options.listen <= 600.0:
        raise ValueError(f"--listen is {options.listen:g}; it must be in [0.1, 600] s.")
    with contextlib.ExitStack() as stack:
        bundle = _open_bundle(options, stack)
        planner, onboard = _load_configs(options)
        if bundle is not None:
            bundle.activate(planner, options.device)
        report = preflight(
            planner, onboard, device=options.device, goal=options.goal, log=options.log, listen=options.listen,
            bundle=bundle, confirm=_confirm_changes if options.set else None,
        )  # fmt: skip
    say(json.dumps(report.to_dict()) if options.json else report.format_table())
    return 0 if report.passed else 2


def _confirm_changes(changes: Sequence[ParameterChange]) -> bool:
    """Ask on the terminal whether to write parameters of the autopilot."""
    for change in changes:
        say(f"{change.name}: {change.before:g} -> {change.value:g}", file=sys.stderr)
    say("Write these parameters to the autopilot? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _export(options: argparse.Namespace) -> int:
    """Compile all kernels ahead of time and write a bundle for `run --bundle`. No GPU is needed.

    If this machine has one of the requested processors, the bundle also contains the graph for the C++ host.
    """
    summary = write_bundle(
        options.out, config=options.config, architectures=options.arch, cpu=options.cpu, overwrite=options.overwrite
    )
    say(summary)
    return 0


def write_bundle(
    out: str | os.PathLike[str], *, config: str, architectures: Iterable[str], cpu: bool, overwrite: bool
) -> str:
    """Write a bundle and return a summary in one line.

    Args:
        out, config, cpu, overwrite: as for `aero_planner.onboard.bundle_export.export_bundle`, with the same errors.
        architectures: GPU architectures, such as "sm_87".
    """
    from aero_planner.deploy.export import parse_architecture
    from aero_planner.onboard.bundle_export import export_bundle

    started = time.monotonic()
    numbers = [parse_architecture(name) for name in architectures]
    manifest = export_bundle(out, config=config, architectures=numbers, cpu=cpu, overwrite=overwrite)
    targets = [f"sm_{number}" for number in manifest["architectures"]]
    if manifest["cpu"]:
        targets.append(manifest["cpu"])
    if manifest["graphs"]:
        targets.append(f"graphs of {' and '.join(manifest['graphs'])}")
    size = sum(file["size"] for file in manifest["files"].values())
    return (
        f"{out}: {', '.join(targets)}; {len(manifest['files'])} files, {size / 1e6:.1f} MB, "
        f"in {time.monotonic() - started:.0f} s"
    )


def _run(options: argparse.Namespace) -> int:
    """Wait for the pilot to switch to OFFBOARD, fly to the goal, and brake or hand back when something is wrong.

    Never arms and never changes the mode. SIGINT, SIGTERM or SIGHUP brings the drone to rest and then stops the
    commands, so that the autopilot's own failsafe takes over. A second SIGINT or SIGTERM stops them at once.
    """
    from aero_planner.onboard.stderr import log_to_stderr

    log_to_stderr()
    with contextlib.ExitStack() as stack:
        bundle = _open_bundle(options, stack)
        planner, onboard = _load_configs(options)
        if bundle is not None:
            bundle.activate(planner, options.device)
        from aero_planner.onboard.run import run_node

        statistics, has_ended = run_node(
            planner, onboard, device=options.device, seed=options.seed, threads=options.threads, goal=options.goal,
            log=options.log, bundle=bundle,
        )  # fmt: skip
    if options.json:
        say(json.dumps(statistics, allow_nan=False))
    if not has_ended:
        # A thread that hangs, for example in a driver, would keep the process alive.
        import logging

        sys.stdout.flush()
        logging.shutdown()
        os._exit(0)
    return 0
