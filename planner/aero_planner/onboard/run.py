"""Run the node as a program, from opening its connections to its end after a signal."""

from __future__ import annotations

import contextlib
import logging
import secrets
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from aero_planner.config import PlannerConfig
from aero_planner.deploy.bundle import Bundle
from aero_planner.onboard.connections import open_lidar, open_link, ros_inputs
from aero_planner.onboard.failsafe_process import FailsafeProcess
from aero_planner.onboard.flight_log import FlightLog
from aero_planner.onboard.interfaces import Observer
from aero_planner.onboard.known_drone import config_on_drone
from aero_planner.onboard.log_place import make_log_path, unwritable
from aero_planner.onboard.mavlink_signing import load_key
from aero_planner.onboard.mission_offer import first_goal
from aero_planner.onboard.node import Node
from aero_planner.onboard.ros_tuning import RosTuning
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from aero_planner.onboard.tuning import Tuning
from aero_planner.planner import Planner

if TYPE_CHECKING:
    from aero_planner.onboard.ros import RosInputs

_log = logging.getLogger("aero_planner")

_STOP_MARGIN = 3.0
"""Time allowed for ending, in addition to the time in which the drone must have come to rest [s]."""

_FAILSAFE_START_TIMEOUT = 30.0
"""Time allowed for the failsafe process to start, on top of the time that the planner took to start [s]."""


def run_node(
    planner_config: PlannerConfig,
    onboard: OnboardConfig,
    *,
    device: str,
    seed: int = 0,
    threads: int | None = None,
    goal: ArrayLike | None = None,
    log: Path | None = None,
    bundle: Bundle | None = None,
) -> tuple[dict[str, Any], bool]:
    """Fly until SIGINT, SIGTERM or SIGHUP.

    The first signal brings the drone to rest and then stops the commands. A second SIGINT or SIGTERM stops them at
    once.

    Args:
        planner_config, onboard: configurations to fly with.
        device, seed, threads: as for `Planner`.
        goal: position [m], shape [3], world frame; None if mission.file says where to fly, or the link.
        log: where the flight log is written, see `aero_planner.onboard.log_place`; None for no flight log.
        bundle: bundle whose kernels are used, after `Bundle.activate`.

    Returns:
        The statistics of the node, and whether all of its threads have ended.

    Raises:
        ValueError: the device can't plan, or an argument is invalid.
        OSError: a connection or the flight log can't be opened.
    """
    if not planner_config.costs.use_ground:
        _log.warning("costs.use_ground is off; the node switches it on to stay above limits.fence_height_min")
    first = first_goal(onboard, goal)
    planner_config = config_on_drone(planner_config, onboard)
    with contextlib.ExitStack() as resources:
        with _planning_errors(device):
            planner = Planner(planner_config, device=device, seed=seed, threads=threads)
        resources.callback(planner.close)
        ros = resources.enter_context(ros_inputs(onboard))
        # The node closes what it takes over; until then this stack does.
        opened = resources.enter_context(contextlib.ExitStack())
        link = opened.enter_context(contextlib.closing(open_link(onboard, planner_config.vehicle, ros)))
        lidar = opened.enter_context(contextlib.closing(open_lidar(onboard, ros)))
        tuning = _open_tuning(planner_config, onboard, ros)
        observers = _open_observers(log, planner_config, onboard, tuning, opened)
        failsafe = FailsafeProcess(onboard, planner_config.vehicle, lambda: link.peer, lambda: link.min_signing_time)
        opened.callback(failsafe.close)
        with _planning_errors(device):
            own = {"goal": first, "observers": observers, "failsafe": failsafe, "tuning": tuning}
            node = Node(planner, link, lidar, onboard, **own)
            plan_time = node.warm_up()
        _log.info("a plan takes %.1f ms on %s", 1e3 * plan_time, planner.device)
        if bundle is not None and bundle.compiled():
            _log.warning("kernels were compiled that the bundle lacks; export it again")
        failsafe.wait_until_running(_FAILSAFE_START_TIMEOUT)
        opened.pop_all()
        has_ended = fly_until_signal(node, onboard)
    return node.statistics(), has_ended


def fly_until_signal(node: Node, onboard: OnboardConfig) -> bool:
    """Start a node and run it until SIGINT, SIGTERM or SIGHUP, as `run_node`; return whether its threads have ended."""
    signals: list[int] = []

    def stop(number: int, _: object) -> None:
        # The system and the shell may both report a lost terminal: a second SIGHUP does not end the node at once.
        if not signals or number != signal.SIGHUP:
            signals.append(number)
        node.stop()

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Under nohup, the flight continues without its terminal.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop)
    node.start()
    _log.info("waiting for states, points and a goal; the pilot arms and switches to OFFBOARD")
    deadline: float | None = None
    try:
        while not node.wait(0.2) and len(signals) < 2:
            if signals and deadline is None:
                deadline = time.monotonic() + onboard.limits.brake_time + _STOP_MARGIN
                _log.info("stopping: a drone under control comes to rest first; a second signal ends the node at once")
            if deadline is not None and time.monotonic() > deadline:
                _log.error("the node has not stopped in time and is ended")
                break
    finally:
        has_ended = node.close()
        _log.info("silent: the autopilot has the drone")
    return has_ended


@contextlib.contextmanager
def _planning_errors(device: str) -> Iterator[None]:
    """Turn errors of the device or its driver into a ValueError."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        raise ValueError(f"the planner can't plan on {device}: {error}") from error


def _open_tuning(planner: PlannerConfig, onboard: OnboardConfig, ros: RosInputs | None) -> Tuning | None:
    settings = onboard.tuning
    has_key = settings.key_file != "none"
    is_in_ros = ros is not None and settings.limits != "none"
    if not has_key and not is_in_ros:
        return None
    # Nobody holds the other key.
    key = load_key(settings.key_file, "tuning.key_file") if has_key else secrets.token_bytes(32)
    tuning = Tuning(planner, onboard, key)
    if has_key:
        _log.info("who holds the key may change: %s", settings.limits)
    if ros is not None and is_in_ros:
        ros.offer(RosTuning(tuning))
        _log.info("every program in ROS may change, as parameters of /aero_planner/tuning: %s", settings.limits)
    return tuning


def _open_observers(
    log: Path | None,
    planner: PlannerConfig,
    onboard: OnboardConfig,
    tuning: Tuning | None,
    opened: contextlib.ExitStack,
) -> list[Observer]:
    observers: list[Observer] = [] if tuning is None else [tuning]
    if log is not None:
        path = make_log_path(log)
        try:
            flight_log = FlightLog(path, planner, onboard)
        except OSError as error:
            raise unwritable(path, error) from error
        observers.append(opened.enter_context(contextlib.closing(flight_log)))
        _log.info("the flight log is %s", flight_log.path)
    if onboard.telemetry.enabled:
        host = onboard.telemetry.host
        try:
            telemetry = Telemetry(planner, onboard, tuning=tuning)
        except OSError as error:
            # The drone can fly without viewers.
            _log.warning("no viewer can connect to %s:%d: %s", host, onboard.telemetry.port, error.strerror or error)
        else:
            observers.append(opened.enter_context(contextlib.closing(telemetry)))
            _log.info("viewers may connect to %s:%d", host, telemetry.port)
    return observers
