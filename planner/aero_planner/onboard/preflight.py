"""Preflight checks: is everything in place to fly? Nothing is commanded."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
import shutil
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from numpy.typing import ArrayLike

from aero_planner.check_report import Check, CheckReport
from aero_planner.config import PlannerConfig
from aero_planner.deploy.bundle import Bundle
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.connections import is_loopback, open_lidar, open_link, ros_inputs, thrust_model
from aero_planner.onboard.failsafe_process import FailsafeProcess
from aero_planner.onboard.input_checks import check_inputs
from aero_planner.onboard.log_place import check_log_place
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_signing import clock_is_set, load_key
from aero_planner.onboard.mission_offer import first_goal
from aero_planner.onboard.px4_parameters import (
    ParameterChange,
    check_parameters,
    find_changes,
    parameter_names,
    read_parameters,
    write_parameters,
)
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import listen
from aero_planner.onboard.tuning_limits import tunable_parameters
from aero_planner.sweeps import sweeps_within

if TYPE_CHECKING:
    from aero_planner.onboard.ros import RosInputs

T = TypeVar("T")

_TIMED_PLANS = 10
_WARM_UP_PLANS = 2
_LOG_RATE = 4e6  # [bytes/s], with a Mid-360 at its full rate
_MIN_DISK = 2e9  # [bytes]
_MIN_RECEIVE_BUFFER = 1_000_000  # [bytes]
_FAILSAFE_TIMEOUT = 20.0  # [s]


def preflight(
    planner: PlannerConfig,
    onboard: OnboardConfig,
    *,
    device: str = "cpu",
    goal: ArrayLike | None = None,
    log: str | Path | None = None,
    listen: float = 3.0,
    bundle: Bundle | None = None,
    confirm: Callable[[Sequence[ParameterChange]], bool] | None = None,
) -> CheckReport:
    """Check this computer, open the connections and listen to them; nothing is commanded.

    Args:
        planner: Configuration of the planner.
        onboard: Configuration of the node.
        device: Device of the planner.
        goal: [m], shape [3], world frame; None expects a goal over the link.
        log: Where the flight log is to be written, see `aero_planner.onboard.log_place`; None for no log.
        listen: Time to listen to sensor and autopilot [s].
        bundle: Bundle whose kernels are used; it must fit configuration and device.
        confirm: Asked whether to write changes of PX4's parameters, which is done if it returns True and the vehicle
            is disarmed; None writes none.
    """
    checks = [_check_configuration(planner, onboard), *_check_versions(log is not None)]
    checks += [_check_device(planner, onboard, device), *_check_bundle(bundle)]
    checks += [check_thrust(planner, onboard), check_memory(planner, onboard), _check_clock(onboard), *_check_disk(log)]
    checks += check_tuning(onboard)
    checks += [*_check_telemetry_port(onboard), *_check_receive_buffer(), _check_failsafe_process(planner, onboard)]
    with contextlib.ExitStack() as opened:

        def open_ros() -> RosInputs | None:
            return opened.enter_context(ros_inputs(onboard))

        ros, ros_check = _open("ROS 2", open_ros)
        link, link_check = _open("autopilot port", lambda: open_link(onboard, planner.vehicle, ros))
        lidar, lidar_check = _open("LiDAR port", lambda: open_lidar(onboard, ros))
        checks += [*([] if ros is None and ros_check.ok else [ros_check]), link_check, lidar_check]
        for connection in (link, lidar):
            if connection is not None:
                opened.callback(connection.close)
        if link is not None and lidar is not None and ros_check.ok:
            checks += [
                *check_inputs(link, lidar, onboard, goal=first_goal(onboard, goal), listen=listen),
                *_check_autopilot(link, onboard),
            ]
            checks += _check_parameters(link, onboard, confirm)
    return CheckReport(tuple(checks), "Ready to fly.", "NOT ready to fly; see above.")


def _check_configuration(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    try:
        check_together(planner, onboard)
    except ValueError as error:
        return Check("configuration", str(error), ok=False, advice="Correct it in the file.")
    return Check("configuration", f"{len(planner.kinds)} instances x {planner.sampling.samples} samples, in range")


def _check_versions(log: bool) -> Iterator[Check]:
    yield Check("python", f"{platform.python_version()} on {platform.machine()}", ok=sys.version_info >= (3, 10))
    packages = [("aero-planner", True), ("numpy", True), ("warp-lang", True), ("pymavlink", True), ("mcap", log)]
    for name, required in packages:
        try:
            yield Check(name, importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            if required:
                yield Check(name, "not installed", ok=False, advice=f"pip install {name}")


def _check_device(planner_config: PlannerConfig, onboard: OnboardConfig, device: str) -> Check:
    """Time plans with as many points as the node's cloud may have."""
    # Imported here because the planner loads Warp, which takes longer than all other checks.
    from aero_planner.forest_cloud import forest_flight
    from aero_planner.planner import Planner

    name, period = f"device {device}", 1e3 / onboard.rates.replan
    state, goal, cloud = forest_flight(onboard.lidar.cloud_points_max)
    try:
        with contextlib.closing(Planner(planner_config, device=device)) as planner:
            times = [planner.plan(state, goal, cloud).stage_ms["total"] for _ in range(_WARM_UP_PLANS + _TIMED_PLANS)][
                _WARM_UP_PLANS:
            ]
    except (RuntimeError, ValueError, MemoryError) as error:
        advice = (
            "Name a device of this computer with --device; free its memory, update its driver, or install the Warp "
            "version that supports it (docs/onboard.md)."
        )
        return Check(name, f"cannot plan: {' '.join(str(error).split())}", ok=False, advice=advice)
    median = statistics.median(times)
    finding = (
        f"plans {len(cloud)} points in {median:.1f} ms (median), {max(times):.1f} ms (worst of {_TIMED_PLANS}); "
        f"a plan is due every {period:.0f} ms"
    )
    advice = "Lower rates.replan or sampling.samples, or plan on the GPU with --device cuda:0."
    return Check(name, finding, ok=median < period, advice=advice)


def _check_bundle(bundle: Bundle | None) -> Iterator[Check]:
    if bundle is not None:
        compiled = bundle.compiled()
        finding = f"{bundle.describe()}; {len(compiled)} files had to be compiled" if compiled else bundle.describe()
        yield Check("bundle", finding, ok=not compiled, advice="Export it again with this version of aero-planner.")


def check_thrust(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    """Check that the hover thrust is plausible and that the planner asks for no more thrust than there is."""
    vehicle, thrust = planner.vehicle, onboard.thrust
    full = thrust_model(onboard, vehicle).force(1.0)
    weight = vehicle.mass * vehicle.gravity
    curve = f" and thrust.curve {thrust.curve:g}, valid only if THR_MDL_FAC is 0" if thrust.curve else ""
    finding = f"hovers at {thrust.hover_thrust:g} with {weight:.1f} N{curve}: at most {full:.1f} N"
    if full < vehicle.thrust_max:
        advice = (
            f"The planner may ask for {vehicle.thrust_max:g} N: lower vehicle.thrust_max, or correct vehicle.mass, "
            "thrust.hover_thrust or thrust.curve."
        )
        return Check("hover thrust", finding, ok=False, advice=advice)
    is_plausible = 1.3 < full / weight < 12.0
    advice = "Measure the hover thrust (docs/onboard.md): thrust to weight should lie between 1.3 and 12."
    return Check("hover thrust", f"{finding}, {full / weight:.1f} times the weight", ok=is_plausible, advice=advice)


def check_memory(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    """Check that the cloud reaches back far enough for the speed limit, see `DroneConfig.sweep_memory`."""
    lidar, most = onboard.lidar, OnboardConfig.find("lidar.older_sweeps").high
    with contextlib.suppress(ValueError, KeyError):  # where they are wrong, the check of the configuration says so
        slowest = tunable_parameters(onboard.tuning.limits)["vehicle.speed_limit"].low
        planner = planner.replace({"vehicle.speed_limit": slowest})
    needed = min(sweeps_within(planner.sweep_memory, lidar.sweep_period), lidar.sweeps + int(most or 0))
    known = lidar.sweeps + lidar.older_sweeps
    finding = f"the cloud reaches back {known * lidar.sweep_period:.1f} s, {known} sweeps"
    advice = (
        f"At a limit of {planner.vehicle.speed_limit:g} m/s, what has left the view stays near for longer: set "
        f"lidar.older_sweeps to {needed - lidar.sweeps} or more."
    )
    return Check("memory", finding, ok=known >= needed, required=False, advice=advice)


def _check_clock(onboard: OnboardConfig) -> Check:
    resolution = time.get_clock_info("monotonic").resolution
    finding = f"{time.strftime('%Y-%m-%d %H:%M:%S')}, monotonic clock with a resolution of {1e6 * resolution:.3g} us"
    is_signed = onboard.mavlink.is_signed
    depends = f"{'signed messages and ' if is_signed else ''}the times in the flight log depend"
    is_right = clock_is_set() and time.gmtime().tm_year < 2038 and resolution < 1e-3
    advice = f"Set the date (timedatectl); {depends} on it."
    return Check("clock", finding, ok=is_right, required=is_signed, advice=advice)


def _check_disk(log: str | Path | None) -> Iterator[Check]:
    if log is None:
        return
    name = "disk for the log"
    try:
        folder = check_log_place(log)
        free = shutil.disk_usage(folder).free
    except OSError as error:
        yield Check(name, str(error), ok=False, advice="The node doesn't start without the log that --log names.")
        return
    minutes = free / _LOG_RATE / 60.0
    finding = f"{free / 1e9:.1f} GB free in {folder}: about {minutes:.0f} min"
    yield Check(name, finding, ok=free > _MIN_DISK, advice="Remove old logs.")


def _check_telemetry_port(onboard: OnboardConfig) -> Iterator[Check]:
    settings, name = onboard.telemetry, "telemetry port"
    if not settings.enabled:
        return
    address = f"{settings.host}:{settings.port}"
    try:
        listen(settings).close()
    except OSError as error:
        advice = "Stop the node that is already running, or set another telemetry.port."
        yield Check(name, f"{address}: {error.strerror or error}", ok=False, required=False, advice=advice)
    else:
        yield Check(name, f"{address} is free")


def check_tuning(onboard: OnboardConfig) -> Iterator[Check]:
    """Check that the key for changes of parameters can be read, and that both settings are made or neither is."""
    settings, name = onboard.tuning, "tuning"
    if settings.key_file != "none":
        try:
            load_key(settings.key_file, "tuning.key_file")
        except ValueError as error:
            yield Check(name, str(error), ok=False, advice="The node doesn't start without the key that it names.")
            return
    elif settings.limits == "none":
        return
    finding = f"who holds the key may change: {settings.limits}"
    is_complete = "none" not in (settings.key_file, settings.limits)
    advice = "Nobody can change anything: that takes tuning.key_file and tuning.limits."
    yield Check(name, finding, ok=is_complete, required=False, advice=advice)


def _check_receive_buffer() -> Iterator[Check]:
    try:
        largest = int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return
    advice = "Points may be lost while the computer is busy; run: sudo sysctl -w net.core.rmem_max=4000000"
    finding = f"up to {largest} bytes"
    yield Check("receive buffer", finding, ok=largest >= _MIN_RECEIVE_BUFFER, required=False, advice=advice)


def _check_failsafe_process(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    start, name = time.monotonic(), "failsafe process"
    try:
        failsafe = FailsafeProcess(onboard, planner.vehicle, lambda: None)
        try:
            failsafe.wait_until_running(_FAILSAFE_TIMEOUT)
        finally:
            failsafe.close()
    except OSError as error:
        advice = "The node doesn't start without the process that brakes if the node's process dies."
        return Check(name, str(error), ok=False, advice=advice)
    return Check(name, f"starts in {time.monotonic() - start:.1f} s")


def _check_autopilot(link: MavlinkLink, onboard: OnboardConfig) -> Iterator[Check]:
    if link.peer is None or link.vehicle_kind is None:
        return
    where = link.peer.removeprefix("udpout:")
    if not link.is_supported:
        advice = (
            "The node commands only a PX4 that flies a multicopter, and nothing else that has its ids: connect one, "
            "name its address in mavlink.url and its id in mavlink.system, and check PX4's MAV_TYPE."
        )
        yield Check("autopilot", f"{link.vehicle_kind} at {where}", ok=False, advice=advice)
        return
    kind, _, rest = onboard.mavlink.url.partition(":")
    is_private = kind != "udpin" or is_loopback(rest.rpartition(":")[0])
    is_signed = onboard.mavlink.is_signed
    advice = (
        "The first one that is heard in the network is obeyed: check that this is its address, and use a serial port, "
        "udpout:ADDRESS:PORT, or mavlink.signing_key_file."
    )
    finding = f"{link.vehicle_kind} at {where}"
    yield Check("autopilot", finding, ok=is_private or is_signed, required=False, advice=advice)


def _check_parameters(
    link: MavlinkLink, onboard: OnboardConfig, confirm: Callable[[Sequence[ParameterChange]], bool] | None
) -> Iterator[Check]:
    """Check PX4's parameters, after writing the changes that `confirm` agrees to."""
    if link.vehicle_kind is None or not link.is_supported:
        return
    names = parameter_names(onboard)
    values = read_parameters(link, names)
    changes = find_changes(values, onboard)
    if changes and confirm is not None and confirm(changes):
        result = write_parameters(link, changes)
        values |= read_parameters(link, [change.name for change in changes])
        unconfirmed = ", ".join(result.unconfirmed)
        if result.refusal:
            advice = "Parameters are written only to a disarmed vehicle: disarm it, and run preflight --set again."
            yield Check("parameters", f"{result.refusal}; not written: {unconfirmed}", ok=False, advice=advice)
        elif unconfirmed:
            advice = "The autopilot did not confirm them: set them with a ground station."
            yield Check("parameters", f"not written: {unconfirmed}", ok=False, advice=advice)
        else:
            yield Check("parameters", f"written: {', '.join(change.name for change in changes)}")
    yield from check_parameters(values, onboard)


def _open(name: str, open_connection: Callable[[], T]) -> tuple[T | None, Check]:
    try:
        connection = open_connection()
    except (OSError, ValueError, ImportError) as error:
        return None, Check(name, str(error), ok=False, advice="Without it, the inputs can't be checked.")
    return connection, Check(name, "open")
