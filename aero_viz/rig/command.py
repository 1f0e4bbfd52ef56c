"""The verb `rig` of `aero-planner`: fly the onboard node against a simulated drone."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from aero_viz.rig.result import RigResult

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the verb with the arguments behind it; return the exit code. Entry point of "aero_planner.commands".

    Raises:
        ValueError: an argument is out of range, or pymavlink is missing; one sentence.
    """
    from aero_planner.warp_init import quieten
    from aero_viz.errors import UserError

    options = _parser().parse_args(arguments)
    quieten()
    try:
        return _fly(options)
    except (UserError, ImportError) as error:
        raise ValueError(str(error)) from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="aero-planner rig",
        description="Fly the node in real time against a simulated PX4 autopilot and Livox Mid-360, over UDP on "
        "127.0.0.1. Exit code 0: done, whatever the outcome of the flight; 2: a mistake in the arguments.",
        epilog=_faults_help(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("world", help="a scene such as forest, or a world's JSON file")
    parser.add_argument("--seed", type=int, default=0, help="of the scene and of the LiDAR (default 0)")
    parser.add_argument("--speed", type=float, help="speed limit [m/s]; the configuration's own, else 5, when left out")
    parser.add_argument("--config", help="YAML file with the planner's and the node's settings, as flown on the drone")
    parser.add_argument("--duration", type=float, default=60.0, help="longest flight [s] (default 60)")
    parser.add_argument("--fault", action="append", default=[], metavar="KIND[=AMOUNT]@TIME[+DURATION]",
                        help="what goes wrong, and when after the take-over [s]; may be repeated")  # fmt: skip
    parser.add_argument("--count", type=int, default=1, help="flights, each with the next seed (default 1)")
    parser.add_argument("--data-type", type=int, choices=(1, 2), default=1,
                        help="of the LiDAR's packets: 1 millimetres (default), 2 centimetres")  # fmt: skip
    parser.add_argument("--pair", action="store_true",
                        help="send LOCAL_POSITION_NED and ATTITUDE_QUATERNION instead of ODOMETRY")  # fmt: skip
    parser.add_argument("--loss-time", type=float, default=0.5, metavar="S",
                        help="PX4's COM_OF_LOSS_T: silence that makes it take over [s] (default 0.5)")  # fmt: skip
    parser.add_argument("--shuttle", action="store_true",
                        help="fly to and fro until the time is over, for statistics of deadlines")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print one JSON object per flight")
    return parser


def _fly(options: argparse.Namespace) -> int:
    from aero_viz.catalog import load_world
    from aero_viz.errors import UserError
    from aero_viz.rig import fly_rig, parse_fault

    faults = [parse_fault(text) for text in options.fault]
    if options.count < 1 or not (options.duration > 0.0 and options.loss_time > 0.0):
        raise UserError("--count, --duration and --loss-time must be positive.")
    config, onboard, speed = None, None, 5.0 if options.speed is None else options.speed
    if options.config is not None:
        from aero_planner.onboard.settings import load_flight_config

        config, onboard = load_flight_config(options.config)
        speed = options.speed
    for seed in range(options.seed, options.seed + options.count):
        result = fly_rig(
            load_world(options.world, seed=seed),
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
            progress=None if options.json else print,
        )
        if options.json:
            print(json.dumps(result.to_dict(), allow_nan=False), flush=True)
        else:
            print(summary(result), flush=True)
            if not result.arrived:
                print("the node's last words:", *result.log[-20:], sep="\n    ", file=sys.stderr)
    return 0


def summary(result: RigResult) -> str:
    """Return a flight's result in a few lines for people."""
    clearance = "" if result.min_clearance is None else f", {result.min_clearance:.2f} m from the nearest surface"
    lines = [
        f"{result.scene} {result.seed}: {result.reason} after {result.flight_time_s:.1f} s, "
        f"{result.mean_speed:.1f} m/s, at most {result.max_speed:.1f} m/s{clearance}"
    ]
    if result.arrivals > 1:
        lines[0] += f"; {result.arrivals} arrivals"
    if result.intervals is not None:
        i = result.intervals
        lines.append(
            f"setpoints: {i.count}, every {1e3 * i.mean:.1f} ms, jitter {1e3 * i.jitter:.2f} ms, "
            f"99 % within {1e3 * i.p99:.1f} ms, longest {1e3 * i.longest:.0f} ms, {i.missed} missed"
        )
    if result.trespasses:
        lines.append(f"THE NODE ASKED FOR WHAT IT MUST NOT: {', '.join(sorted(set(result.trespasses)))}")
    if result.overruns:
        lines.append(f"the simulation itself was late {result.overruns} times: this machine is busy")
    return "\n".join(lines)


def _faults_help() -> str:
    from aero_viz.rig.faults import FAULT_KINDS

    lines = ["faults:"]
    for name, kind in FAULT_KINDS.items():
        amount = f", {kind.amount:g}" if kind.amount else ""
        duration = f", {kind.duration:g} s" if kind.duration else ""
        lines.append(f"  {name:14} {kind.help}{amount}{duration}")
    return "\n".join(lines)
