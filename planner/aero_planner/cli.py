"""The command line on the drone: `aero-planner run`, `preflight`, `export`, `config`, and verbs of other packages.

A package adds a verb by an entry point in the group "aero_planner.commands": its name is the verb, its value a function
that takes the arguments behind it, a list of strings, and returns an exit code or None.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aero_planner.cli_util import INTERRUPTED, abandon_output

if TYPE_CHECKING:
    from aero_planner.config import PlannerConfig
    from aero_planner.deploy.bundle import Bundle
    from aero_planner.onboard.node import Node
    from aero_planner.onboard.observer import Observer
    from aero_planner.onboard.settings import OnboardConfig

__all__ = ["GROUP", "main", "write_bundle"]

GROUP = "aero_planner.commands"
"""Entry points that are verbs."""

_log = logging.getLogger("aero_planner")

_PATIENCE = 3.0
"""Beyond the time in which the drone must have come to rest [s]."""

_FAILSAFE_TIMEOUT = 30.0
"""Time for the failsafe process to start, in addition to the time of the planner's start [s]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0 when done, 2 for a user's mistake or a failed check, 130 after Ctrl-C."""
    try:
        # Imported here, so that Ctrl-C ends this quietly as well.
        from importlib.metadata import entry_points

        from aero_planner.config.parameter import did_you_mean

        given = list(sys.argv[1:] if arguments is None else arguments)
        others = {point.name: point for point in entry_points(group=GROUP)}
        verbs = [*_VERBS, *sorted(others)]
        if given and given[0] in others and given[0] not in _VERBS:
            return int(others[given[0]].load()(given[1:]) or 0)
        if given and not given[0].startswith("-") and given[0] not in verbs:
            raise ValueError(
                f"there is no verb {given[0]!r}{did_you_mean(given[0], verbs)}; verbs: {', '.join(verbs)}."
            )
        options = _parser(sorted(others)).parse_args(given)
        if options.verb is None:
            _parser(sorted(others)).print_help()
            return 2
        code = options.call(options)
        sys.stdout.flush()
        return code
    except (ValueError, ImportError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            return abandon_output()
        if os.environ.get("AERO_PLANNER_DEBUG"):
            raise
        print(f"aero-planner: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def _parser(others: Sequence[str]) -> argparse.ArgumentParser:
    more = f"Verbs of other packages: {', '.join(others)}." if others else None
    parser = argparse.ArgumentParser(prog="aero-planner", description="Fly with the AERO-MPPI planner.", epilog=more)
    parser.add_argument("--version", action="version", version=f"aero-planner {_version()}")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB")
    files = argparse.ArgumentParser(add_help=False)
    files.add_argument(
        "--config",
        help="preset, or YAML file saved from the dashboard; settings of the node stand in it under 'onboard:'",
    )
    files.add_argument(
        "--onboard", metavar="FILE", help="YAML file with the settings of the node, where not in --config"
    )
    flight = argparse.ArgumentParser(add_help=False, parents=[files])
    flight.add_argument(
        "--goal", nargs=3, type=float, metavar=("X", "Y", "Z"), help="where to fly: north, west, up [m]"
    )
    flight.add_argument("--device", default="cpu", help="of the planner: cpu or cuda:0")
    flight.add_argument(
        "--bundle", metavar="PATH", help="kernels to use instead of a compiler, and the configuration without --config"
    )
    flight.add_argument("--log", type=Path, metavar="PATH", help="MCAP file to write, or folder for one with a date")

    run = verbs.add_parser(
        "run", parents=[flight], help="fly when the pilot switches to OFFBOARD", description=_run.__doc__
    )
    run.add_argument("--seed", type=int, default=0, help="of the planner's noise")
    run.add_argument("--threads", type=int, help="CPU threads of the planner; one per core otherwise")
    run.add_argument("--json", action="store_true", help="print statistics as one JSON object at the end")
    run.set_defaults(call=_run)

    check = verbs.add_parser(
        "preflight", parents=[flight], help="check that all is there to fly", description=_check.__doc__
    )
    check.add_argument("--listen", type=float, default=3.0, help="how long to listen to sensor and autopilot [s]")
    check.add_argument("--json", action="store_true", help="print one JSON object")
    check.set_defaults(call=_check)

    export = verbs.add_parser("export", help="compile for a drone that has no compiler", description=_export.__doc__)
    export.add_argument("out", metavar="OUT[.tar]", help="folder or tar file to write")
    export.add_argument(
        "--config", default="default", help="preset or YAML file; settings of the node stand in it under 'onboard:'"
    )
    export.add_argument(
        "--arch", action="append", default=[], metavar="sm_87", help="of a GPU; may be given several times"
    )
    export.add_argument("--cpu", action="store_true", help="for this machine's CPU")
    export.set_defaults(call=_export)

    config = verbs.add_parser("config", help="show or validate a configuration")
    actions = config.add_subparsers(dest="action", required=True, metavar="ACTION")
    show = actions.add_parser("show", parents=[files], help="print every parameter, as a file that can be edited")
    show.set_defaults(call=_show)
    validate = actions.add_parser("validate", help="check a file")
    validate.add_argument("file", help="YAML file with planner parameters, settings of the node, or both")
    validate.set_defaults(call=_validate)
    return parser


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("aero-planner")
    except PackageNotFoundError:
        return "(not installed)"


def _bundle(options: argparse.Namespace, stack: contextlib.ExitStack) -> Bundle | None:
    """Return the bundle that the options name, until the stack unwinds; its configuration is the default then."""
    if options.bundle is None:
        return None
    from aero_planner.deploy.bundle import open_bundle

    bundle = stack.enter_context(open_bundle(options.bundle))
    options.config = options.config or str(bundle.config_file)
    return bundle


def _load(options: argparse.Namespace) -> tuple[PlannerConfig, OnboardConfig]:
    """Return the configurations that the options name."""
    from aero_planner.config import PlannerConfig
    from aero_planner.config.file import config_from_name
    from aero_planner.onboard.settings import OnboardConfig, check_together, load_flight_config, load_onboard

    name = options.config or "default"
    if name not in PlannerConfig.presets() and Path(name).exists():
        planner, onboard = load_flight_config(name)
    else:
        planner, onboard = config_from_name(name), OnboardConfig()
    if options.onboard is not None:
        onboard = load_onboard(options.onboard)
    check_together(planner, onboard)
    return planner, onboard


def _show(options: argparse.Namespace) -> int:
    from aero_planner.config.file import format_config
    from aero_planner.onboard.settings import format_onboard

    planner, onboard = _load(options)
    print(f"{format_config(planner)}\n{format_onboard(onboard)}", end="")
    return 0


def _validate(options: argparse.Namespace) -> int:
    from aero_planner.onboard.settings import check_together, load_any

    check_together(*load_any(options.file))
    print(f"{options.file} is valid")
    return 0


def _check(options: argparse.Namespace) -> int:
    """Check versions, device, ports, sensor, autopilot, thrust and disk. Nothing is commanded. Exit code 0 or 2."""
    from aero_planner.onboard.preflight import preflight

    if not 0.1 <= options.listen <= 600.0:
        raise ValueError(f"--listen is {options.listen:g}; it must be in [0.1, 600] s.")
    with contextlib.ExitStack() as stack:
        bundle = _bundle(options, stack)
        planner, onboard = _load(options)
        if bundle is not None:
            bundle.fit(planner, options.device)
        report = preflight(
            planner, onboard, device=options.device, goal=options.goal, log=options.log, listen=options.listen,
            bundle=bundle,
        )  # fmt: skip
    print(json.dumps(report.to_json()) if options.json else report.format_table())
    return 0 if report.passed else 2


def _export(options: argparse.Namespace) -> int:
    """Compile every kernel ahead and write a bundle for `run --bundle`. No GPU is needed.

    Where this machine has one of the processors itself, the graph for the C++ host comes along.
    """
    print(write_bundle(options.out, config=options.config, architectures=options.arch, cpu=options.cpu))
    return 0


def write_bundle(out: str | os.PathLike[str], *, config: str, architectures: Iterable[str], cpu: bool) -> str:
    """Write a bundle and return the line that tells of it.

    Args:
        out, config, cpu: as of `aero_planner.deploy.export.export`, which also says what is raised.
        architectures: of GPUs, such as "sm_87".
    """
    from aero_planner.deploy.export import export, parse_architecture

    began = time.monotonic()
    manifest = export(out, config=config, architectures=[parse_architecture(one) for one in architectures], cpu=cpu)
    targets = [f"sm_{one}" for one in manifest["architectures"]] + ([manifest["cpu"]] if manifest["cpu"] else [])
    if manifest["graphs"]:
        targets.append(f"graphs of {' and '.join(manifest['graphs'])}")
    size = sum(one["size"] for one in manifest["files"].values())
    return (
        f"{out}: {', '.join(targets)}; {len(manifest['files'])} files, {size / 1e6:.1f} MB, "
        f"in {time.monotonic() - began:.0f} s"
    )


def _run(options: argparse.Namespace) -> int:
    """Wait for the pilot to switch to OFFBOARD, fly to the goal, brake or hand back when something is wrong.

    Never arms and never changes the mode. SIGINT, SIGTERM or SIGHUP brings the drone to rest and then stops the
    commands, so that the autopilot's own failsafe takes over; a second SIGINT or SIGTERM stops them at once.
    """
    from aero_planner.onboard.stderr import log_to_stderr

    log_to_stderr()
    with contextlib.ExitStack() as stack:
        ended = _run_with(_bundle(options, stack), options)
    if not ended:
        # What hangs in a driver, say, would keep the process from ending.
        sys.stdout.flush()
        logging.shutdown()
        os._exit(0)
    return 0


def _run_with(bundle: Bundle | None, options: argparse.Namespace) -> bool:
    """Fly as the options say; return whether every thread of the node has ended."""
    from aero_planner.onboard.connections import open_lidar, open_link
    from aero_planner.onboard.failsafe_process import FailsafeProcess
    from aero_planner.onboard.node import Node
    from aero_planner.planner import Planner

    planner_config, onboard = _load(options)
    if bundle is not None:
        bundle.fit(planner_config, options.device)
    with _plannable(options.device):
        planner = Planner(planner_config, device=options.device, seed=options.seed, threads=options.threads)
    opened: list[Any] = []
    try:
        link = _opened(opened, lambda: open_link(onboard, planner_config.vehicle))
        lidar = _opened(opened, lambda: open_lidar(onboard))
        observers = _observers(options, planner_config, onboard, opened)
        failsafe = _opened(opened, lambda: FailsafeProcess(onboard, planner_config.vehicle, lambda: link.peer))
        with _plannable(options.device):
            node = Node(planner, link, lidar, onboard, goal=options.goal, observers=observers, failsafe=failsafe)
            took = node.warm_up()
        _log.info("a plan takes %.1f ms on %s", 1e3 * took, planner.device)
        if bundle is not None and bundle.compiled():
            _log.warning("kernels were compiled that the bundle lacks; export it again")
        failsafe.wait_until_running(_FAILSAFE_TIMEOUT)
        opened.clear()
        ended = fly(node, onboard)
    finally:
        for one in opened:
            one.close()
        planner.close()
    if options.json:
        print(json.dumps(node.statistics(), allow_nan=False))
    return ended


@contextlib.contextmanager
def _plannable(device: str) -> Iterator[None]:
    """Turn what a device, or its driver, lacks for planning into a user's error."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        raise ValueError(f"the planner can't plan on {device}: {error}") from error


def _opened(opened: list[Any], make: Callable[[], Any]) -> Any:
    opened.append(make())
    return opened[-1]


def _observers(
    options: argparse.Namespace, planner: PlannerConfig, onboard: OnboardConfig, opened: list[Any]
) -> list[Observer]:
    from aero_planner.onboard.flight_log import FlightLog
    from aero_planner.onboard.telemetry import Telemetry

    observers: list[Observer] = []
    if options.log is not None:
        name = time.strftime("flight_%Y%m%d_%H%M%S.mcap")
        path = options.log / name if options.log.is_dir() else options.log
        try:
            observers.append(log := _opened(opened, lambda: FlightLog(path, planner, onboard)))
        except OSError as error:
            raise OSError(f"the flight log {path} can't be written: {error.strerror or error}.") from error
        _log.info("the flight log is %s", log.path)
    if onboard.telemetry.enabled:
        try:
            telemetry = _opened(opened, lambda: Telemetry(planner, onboard))
        except OSError as error:
            # A drone that nobody watches flies as well.
            place = f"{onboard.telemetry.host}:{onboard.telemetry.port}"
            _log.warning("nobody can watch: %s can't be listened on: %s", place, error.strerror or error)
        else:
            observers.append(telemetry)
            _log.info("viewers may connect to %s:%d", onboard.telemetry.host, telemetry.port)
    return observers


def fly(node: Node, onboard: OnboardConfig) -> bool:
    """Run the node until it is told to end and has fallen silent; return whether all of its threads have ended."""
    told: list[int] = []

    def end(number: int, _: object) -> None:
        # A terminal that goes away may say so twice, the system and the shell: that is not to end at once.
        if not told or number != signal.SIGHUP:
            told.append(number)
        node.stop()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Under nohup the flight outlives its terminal.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
    node.start()
    _log.info("waiting for states, points and a goal; the pilot arms and switches to OFFBOARD")
    limit: float | None = None
    try:
        while not node.wait(0.2) and len(told) < 2:
            if told and limit is None:
                limit = time.monotonic() + onboard.limits.brake_time + _PATIENCE
                _log.info("told to end: the drone is brought to rest if it is ours; once more ends at once")
            if limit is not None and time.monotonic() > limit:
                _log.error("the node does not fall silent by itself and is ended")
                break
    finally:
        ended = node.close()
        _log.info("silent: the autopilot has the drone")
    return ended


_VERBS = ("run", "preflight", "export", "config")
