"""The command `aero-planner rig`: fly the onboard node against a simulated drone."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence

from aero_planner.cli_util import Parser
from aero_planner.plain_text import say
from aero_viz.rig.px4_log import Px4LogSummary
from aero_viz.rig.result import RigResult


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return the exit code. This is an entry point in the group "aero_planner.commands".

    Args:
        arguments: arguments after the command.

    Raises:
        ValueError: an argument is out of range, or pymavlink is missing; the message is one sentence.
    """
    from aero_planner.warp_init import init_warp
    from aero_viz.errors import UserError

    options = make_parser().parse_args(arguments)
    init_warp()
    try:
        return _fly(options)
    except (UserError, ImportError) as error:
        raise ValueError(str(error)) from error


def make_parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="aero-planner rig",
        description="Fly the node in real time against a simulated PX4 autopilot and Livox Mid-360, over UDP on "
        "127.0.0.1. The exit code is 0 whatever the outcome of the flight, and 2 for a mistake in the arguments.",
        epilog=_faults_help(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("world", help="name of a scene, such as forest, or a world file (JSON)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the scene and of the LiDAR (default 0)")
    parser.add_argument("--speed", type=float, help="speed limit [m/s] (default: the one in --config, else 5)")
    parser.add_argument("--config", help="preset, or YAML file with settings of planner and node, as on the drone")
    parser.add_argument("--duration", type=float, default=60.0, help="longest flight [s] (default 60)")
    parser.add_argument("--fault", action="append", default=[], metavar="KIND[=AMOUNT]@TIME[+DURATION]",
                        help="fault to inject, TIME seconds after the node gets control; may be repeated")  # fmt: skip
    parser.add_argument("--count", type=int, default=1, help="number of flights, each with the next seed (default 1)")
    parser.add_argument("--data-type", type=int, choices=(1, 2), default=1,
                        help="data type of the LiDAR's packets: 1 millimetres (default), 2 centimetres")  # fmt: skip
    parser.add_argument("--pair", action="store_true",
                        help="send LOCAL_POSITION_NED and ATTITUDE_QUATERNION instead of ODOMETRY")  # fmt: skip
    parser.add_argument("--loss-time", type=float, metavar="S",
                        help="time without setpoints after which the autopilot takes over, PX4's COM_OF_LOSS_T "
                        "[s] (default 0.5; with PX4, what preflight sets)")  # fmt: skip
    parser.add_argument("--autopilot", choices=("own", "px4"), default="own",
                        help="the rig's own autopilot and vehicle (default), or PX4 in its own simulation")  # fmt: skip
    parser.add_argument("--px4", metavar="DIR", help="folder of PX4's sources, in which you have built its simulation "
                        "by PX4's own guide (make px4_sitl_default)")  # fmt: skip
    parser.add_argument("--parameter", action="append", default=[], metavar="NAME=VALUE",
                        help="parameter of PX4 to set before the flight; may be repeated")  # fmt: skip
    parser.add_argument("--lockstep", action="store_true",
                        help="fly in simulated time, with the node in this process, for a busy machine")  # fmt: skip
    parser.add_argument("--shuttle", action="store_true",
                        help="fly back and forth until the duration is over, for statistics of deadlines")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print one JSON object per flight")
    return parser


def _fly(options: argparse.Namespace) -> int:
    from aero_viz.catalog import load_world
    from aero_viz.errors import UserError
    from aero_viz.rig import fly_rig, parse_fault
    from aero_viz.scenes import SCENES

    faults = [parse_fault(text) for text in options.fault]
    if options.count < 1 or not (options.duration > 0.0 and (options.loss_time is None or options.loss_time > 0.0)):
        raise UserError("--count, --duration and --loss-time must be positive.")
    parameters = _check_px4(options)
    config, onboard, speed = None, None, 5.0 if options.speed is None else options.speed
    if options.config is not None:
        from aero_planner.onboard.flight_config import load_checked

        config, onboard = load_checked(options.config)
        speed = options.speed
    for seed in range(options.seed, options.seed + options.count):
        result = fly_rig(
            load_world(SCENES.admit(options.world), seed=seed),
            seed=seed,
            speed=speed,
            faults=faults,
            duration=options.duration,
            config=config,
            onboard=onboard,
            data_type=options.data_type,
            state_pair=options.pair,
            loss_time=options.loss_time,
            shuttle=options.shuttle,
            lockstep=options.lockstep,
            px4=options.px4,
            px4_parameters=parameters,
            progress=None if options.json else print,
        )
        if options.json:
            say(json.dumps(result.to_dict(), allow_nan=False), flush=True)
        else:
            say(format_result(result), flush=True)
            if not result.arrived:
                say("last lines of the node's log:", *result.log[-20:], sep="\n    ", file=sys.stderr)
    return 0


def _check_px4(options: argparse.Namespace) -> dict[str, float]:
    """Check the options for PX4 and return its parameters by name."""
    from aero_viz.errors import UserError
    from aero_viz.rig.px4_process import find_px4

    if options.autopilot == "own":
        if options.px4 is not None or options.parameter:
            raise UserError("--px4 and --parameter need --autopilot px4.")
        return {}
    if options.px4 is None:
        raise UserError("--autopilot px4 needs --px4 DIR, the folder of PX4's sources, in which PX4 was built.")
    if options.pair:
        raise UserError("--pair is an option of the rig's own autopilot.")
    find_px4(options.px4)
    parameters = {}
    for text in options.parameter:
        name, _, value = text.partition("=")
        try:
            parameters[name.strip()] = float(value)
        except ValueError:
            raise UserError(f"--parameter {text} is not of the form NAME=VALUE, with a number.") from None
    return parameters


def format_result(result: RigResult) -> str:
    """Return the result of a flight in a few lines of text."""
    clearance = "" if result.min_clearance is None else f", {result.min_clearance:.2f} m from the nearest surface"
    lines = [
        f"{result.scene} {result.seed}: {result.reason} after {result.flight_time_s:.1f} s, "
        f"{result.mean_speed:.1f} m/s, at most {result.max_speed:.1f} m/s{clearance}"
    ]
    if result.arrivals > 1:
        lines[0] += f"; {result.arrivals} arrivals"
    if result.intervals is not None:
        gaps = result.intervals
        lines.append(
            f"setpoints: {gaps.count}, every {1e3 * gaps.mean:.1f} ms, jitter {1e3 * gaps.jitter:.2f} ms, "
            f"99 % within {1e3 * gaps.p99:.1f} ms, longest {1e3 * gaps.longest:.0f} ms, {gaps.missed} missed"
        )
    if result.sign_changes is not None:
        changes = ", ".join(f"{number:.1f}" for number in result.sign_changes)
        lines.append(f"setpoints: {changes} sign changes per second in roll, pitch, yaw")
    if result.handover is not None:
        gone = result.handover
        tilt = math.degrees(gone.tilt)
        lines.append(f"left OFFBOARD after {gone.time:.1f} s at {gone.speed:.2f} m/s, tilted by {tilt:.1f} deg")
    if result.px4_log is not None:
        lines += _format_log(result.px4_log)
    if result.violations:
        lines.append(f"VIOLATION: the node requested {', '.join(sorted(set(result.violations)))}; only the pilot may")
    if result.overruns:
        lines.append(f"the simulation was late {result.overruns} times: this machine is too slow or too busy")
    return "\n".join(lines)


def _format_log(log: Px4LogSummary) -> list[str]:
    def numbers(values: Sequence[float], scale: float, form: str) -> str:
        return ", ".join("unknown" if math.isnan(value) else format(scale * value, form) for value in values)

    return [
        f"PX4's log: estimate off by up to {log.position_error:.2f} m, {log.height_error:.2f} m in height; "
        f"{log.velocity_error:.2f} m/s and {math.degrees(log.tilt_error):.1f} deg (root mean squares)",
        f"PX4's log: lags of roll, pitch, yaw {numbers(log.rate_lags, 1e3, '.0f')} ms, "
        f"{numbers(log.sign_changes, 1.0, '.1f')} sign changes per second, a motor at its limit "
        f"{100 * log.saturated:.1f} % of the time, hover thrust {numbers([log.hover_thrust], 1.0, '.3f')}",
    ]


def _faults_help() -> str:
    from aero_viz.rig.faults import FAULT_KINDS

    lines = ["faults:"]
    for name, kind in FAULT_KINDS.items():
        amount = f", {kind.amount:g}" if kind.amount else ""
        duration = f", {kind.duration:g} s" if kind.duration else ""
        lines.append(f"  {name:14} {kind.help}{amount}{duration}")
    return "\n".join(lines)
