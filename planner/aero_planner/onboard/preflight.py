"""Is everything there to fly? A list of checks, each with what was found and what to do."""

from __future__ import annotations

import contextlib
import importlib.metadata
import math
import platform
import shutil
import socket
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import PlannerConfig
from aero_planner.deploy.bundle import Bundle
from aero_planner.onboard.connections import open_lidar, open_link
from aero_planner.onboard.failsafe_process import FailsafeProcess
from aero_planner.onboard.point_source import PointSource
from aero_planner.onboard.safety_machine import inside_fence
from aero_planner.onboard.settings import OnboardConfig, check_together
from aero_planner.onboard.sweep_buffer import SweepBuffer
from aero_planner.onboard.thrust import force_from_signal
from aero_planner.onboard.vehicle_link import VehicleLink, VehicleSample
from aero_planner.quaternions import quaternion_from_angles

__all__ = ["Check", "PreflightReport", "check_inputs", "preflight"]

_POLL = 0.01
_LEAST_STATE_RATE = 25.0  # [Hz]
_LEAST_POINTS = 1000  # of a sweep
_MOST_LOST = 0.02  # of packets
_LOG_RATE = 4e6  # [bytes/s], a Mid-360 at its full rate
_LEAST_DISK = 2e9  # [bytes]
_LEAST_RECEIVE_BUFFER = 1_000_000  # [bytes]
_GUARD_TIME = 20.0  # [s]


@dataclass(frozen=True)
class Check:
    """One thing looked at."""

    name: str
    found: str
    ok: bool = True
    advice: str = ""
    """What to do when it is not ok."""
    required: bool = True
    """Whether flying without it is out of the question."""


@dataclass(frozen=True)
class PreflightReport:
    """All checks."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether everything required is ok."""
        return all(check.ok or not check.required for check in self.checks)

    def to_json(self) -> dict[str, Any]:
        """Return {"passed": bool, "checks": [..]}."""
        return {"passed": self.passed, "checks": [asdict(check) for check in self.checks]}

    def format_table(self) -> str:
        """Return one line per check, with advice below what is not ok."""
        width = max(len(check.name) for check in self.checks)
        lines = []
        for check in self.checks:
            mark = "ok  " if check.ok else "FAIL" if check.required else "warn"
            lines.append(f"{mark}  {check.name:{width}}  {check.found}")
            if not check.ok:
                lines.append(f"{'':6}{'':{width}}  -> {check.advice}")
        lines.append("Ready to fly." if self.passed else "NOT ready to fly; see above.")
        return "\n".join(lines)


def preflight(
    planner: PlannerConfig,
    onboard: OnboardConfig,
    *,
    device: str = "cpu",
    goal: ArrayLike | None = None,
    log: str | Path | None = None,
    listen: float = 3.0,
    bundle: Bundle | None = None,
) -> PreflightReport:
    """Look at this computer, open the connections and listen to them; nothing is commanded.

    Args:
        planner, onboard: configurations to fly with.
        device: of the planner.
        goal: [m], shape [3], world frame; None expects one over the link.
        log: file or folder of the flight log; None for none.
        listen: how long to listen to sensor and autopilot [s].
        bundle: whose kernels are used; it fits.
    """
    checks = [_configuration(planner, onboard), *_versions(log is not None), _device(planner, onboard, device)]
    checks += _bundle(bundle)
    checks += [_thrust(planner, onboard), _clock(), *_disk(log), *_telemetry_port(onboard), *_receive_buffer()]
    checks.append(_guard(planner, onboard))
    link, link_check = _open("autopilot port", lambda: open_link(onboard, planner.vehicle))
    lidar, lidar_check = _open("LiDAR port", lambda: open_lidar(onboard))
    checks += [link_check, lidar_check]
    try:
        if link is not None and lidar is not None:
            checks += check_inputs(link, lidar, onboard, goal=goal, listen=listen)
    finally:
        for connection in (link, lidar):
            if connection is not None:
                connection.close()
    return PreflightReport(tuple(checks))


def _configuration(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    try:
        check_together(planner, onboard)
    except ValueError as error:
        return Check("configuration", str(error), False, "Correct it in the file.")
    return Check("configuration", f"{len(planner.kinds)} instances x {planner.sampling.samples} samples, in range")


def _versions(log: bool) -> Iterator[Check]:
    yield Check("python", f"{platform.python_version()} on {platform.machine()}", sys.version_info >= (3, 10))
    wanted = [("aero-planner", True, ""), ("numpy", True, ""), ("warp-lang", True, "")]
    wanted += [("pymavlink", True, "[mavlink]"), ("mcap", log, "[log]")]
    for name, required, extra in wanted:
        try:
            yield Check(name, importlib.metadata.version(name))
        except importlib.metadata.PackageNotFoundError:
            if required:
                yield Check(name, "not installed", False, f"pip install 'aero-planner{extra}'")


def _device(planner: PlannerConfig, onboard: OnboardConfig, device: str) -> Check:
    from aero_planner.forest_cloud import forest_cloud
    from aero_planner.plan import Goal, VehicleState
    from aero_planner.planner import Planner

    name, period = f"device {device}", 1.0 / onboard.rates.replan
    try:
        with contextlib.closing(Planner(planner, device=device)) as one:
            cloud = forest_cloud(onboard.lidar.points_max)
            state = VehicleState((0.0, 0.0, 2.0), (4.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
            took = [one.plan(state, Goal((30.0, 0.0, 2.0)), cloud).stage_ms["total"] for _ in range(12)]
    except (RuntimeError, ValueError, MemoryError) as error:
        advice = (
            "Give a device of this computer with --device; free its memory, update its driver, or install the Warp "
            "that goes with it (docs/onboard.md)."
        )
        return Check(name, f"cannot plan: {' '.join(str(error).split())}", False, advice)
    median = statistics.median(took[2:])
    advice = "Lower rates.replan or sampling.samples, or plan on the GPU with --device cuda:0."
    found = f"plans {len(cloud)} points in {median:.1f} ms (median), {max(took[2:]):.1f} ms (worst of 10)"
    return Check(name, f"{found}; a plan is due every {1e3 * period:.0f} ms", median < 1e3 * period, advice)


def _bundle(bundle: Bundle | None) -> Iterator[Check]:
    if bundle is not None:
        lacking = bundle.compiled()
        found = f"{bundle.describe()}; {len(lacking)} files had to be compiled" if lacking else bundle.describe()
        yield Check("bundle", found, not lacking, "Export it again with this version of aero-planner.")


def _thrust(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    vehicle, thrust = planner.vehicle, onboard.thrust
    full = force_from_signal(
        1.0, mass=vehicle.mass, gravity=vehicle.gravity, hover_thrust=thrust.hover_thrust, curve=thrust.curve
    )
    weight = vehicle.mass * vehicle.gravity
    curve = f" and thrust.curve {thrust.curve:g}, right only where THR_MDL_FAC is 0" if thrust.curve else ""
    found = f"hovers at {thrust.hover_thrust:g} with {weight:.1f} N{curve}: at most {full:.1f} N"
    if full < vehicle.thrust_max:
        advice = (
            f"The planner may ask for {vehicle.thrust_max:g} N: lower vehicle.thrust_max, or correct vehicle.mass, "
            "thrust.hover_thrust or thrust.curve."
        )
        return Check("hover thrust", found, False, advice)
    plausible = 1.3 < full / weight < 12.0
    advice = "Measure the hover thrust (docs/onboard.md): thrust to weight should lie between 1.3 and 12."
    return Check("hover thrust", f"{found}, {full / weight:.1f} times the weight", plausible, advice)


def _clock() -> Check:
    year = time.gmtime().tm_year
    resolution = time.get_clock_info("monotonic").resolution
    found = f"{time.strftime('%Y-%m-%d %H:%M:%S')}, monotonic to {1e6 * resolution:.3g} us"
    advice = "Set the date (timedatectl); the flight log's times depend on it."
    return Check("clock", found, 2024 <= year < 2100 and resolution < 1e-3, advice, required=False)


def _disk(log: str | Path | None) -> Iterator[Check]:
    if log is None:
        return
    folder = Path(log) if Path(log).is_dir() else Path(log).resolve().parent
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        advice = "Make the folder, or name another one with --log."
        yield Check("disk for the log", f"{folder}: {error.strerror}", False, advice)
        return
    minutes = free / _LOG_RATE / 60.0
    found = f"{free / 1e9:.1f} GB free in {folder}: about {minutes:.0f} min"
    yield Check("disk for the log", found, free > _LEAST_DISK, "Remove old logs.")


def _telemetry_port(onboard: OnboardConfig) -> Iterator[Check]:
    settings = onboard.telemetry
    if not settings.enabled:
        return
    place = f"{settings.host}:{settings.port}"
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((settings.host, settings.port))
        except OSError as error:
            advice = "Stop the node that runs already, or set another telemetry.port."
            yield Check("telemetry port", f"{place}: {error.strerror or error}", False, advice, required=False)
            return
    yield Check("telemetry port", f"{place} is free")


def _receive_buffer() -> Iterator[Check]:
    try:
        largest = int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return
    advice = "Points may get lost while the computer is busy: sudo sysctl -w net.core.rmem_max=4000000"
    found = f"up to {largest} bytes"
    yield Check("receive buffer", found, largest >= _LEAST_RECEIVE_BUFFER, advice, required=False)


def _guard(planner: PlannerConfig, onboard: OnboardConfig) -> Check:
    began = time.monotonic()
    try:
        guard = FailsafeProcess(onboard, planner.vehicle, lambda: None)
        try:
            guard.wait(_GUARD_TIME)
        finally:
            guard.close()
    except OSError as error:
        return Check("guard", str(error), False, "The node doesn't start without what brakes when it dies.")
    return Check("guard", f"a process of its own, which starts in {time.monotonic() - began:.1f} s")


def _open(name: str, make: Callable[[], Any]) -> tuple[Any, Check]:
    try:
        connection = make()
    except (OSError, ValueError, ImportError) as error:
        return None, Check(name, str(error), False, "Nothing could be listened to.")
    return connection, Check(name, "open")


def check_inputs(
    link: VehicleLink,
    lidar: PointSource,
    onboard: OnboardConfig,
    *,
    goal: ArrayLike | None = None,
    listen: float = 3.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> list[Check]:
    """Listen to autopilot and LiDAR and return what can be said of them.

    Args:
        link: to the autopilot; nothing is commanded.
        lidar: the sensor.
        onboard: settings.
        goal: [m], shape [3], world frame; None expects one over the link.
        listen: for how long [s].
        clock, sleep: of the host [s].
    """
    settings = onboard.lidar
    sweeps = SweepBuffer(
        settings.sweeps,
        settings.sweep_period,
        settings.points_max,
        mount_position=(settings.mount_x, settings.mount_y, settings.mount_z),
        mount_quaternion=quaternion_from_angles(settings.mount_roll, settings.mount_pitch, settings.mount_yaw),
        clock=clock,
    )
    states, points, newest = 0, 0, -math.inf
    last: VehicleSample | None = None
    began = clock()
    while clock() - began < listen:
        link.poll()
        sample = link.state
        if sample is not None and (last is None or sample.time > last.time):
            states += 1
            sweeps.add_pose(sample.time, sample.state.position, sample.state.quaternion)
        last = sample
        for packet in lidar.poll():
            points += len(packet.times)
            newest = max(newest, float(packet.times.max(initial=-math.inf)))
            sweeps.add_points(packet.points, packet.times)
        sleep(_POLL)
    now = clock()
    took = now - began
    checks = [*_vehicle(last, states / took, now, onboard), *_dropped(link)]
    checks += _points(lidar, points, points / took * settings.sweep_period, now - newest, sweeps.dropped, onboard)
    checks += _places(last, goal if goal is not None else link.goal, onboard)
    return checks


def _vehicle(sample: VehicleSample | None, rate: float, now: float, onboard: OnboardConfig) -> list[Check]:
    if sample is None:
        advice = (
            "Check cable, mavlink.url, the autopilot's baud rate, and that it sends ODOMETRY or LOCAL_POSITION_NED and "
            "ATTITUDE_QUATERNION, for which it needs a position estimate."
        )
        return [Check("vehicle state", "nothing arrived", False, advice)]
    age, heartbeat = now - sample.time, now - sample.heartbeat_time
    limits = onboard.limits
    often = rate >= _LEAST_STATE_RATE
    fresh = often and age <= limits.state_age
    advice = "They are late: check the link's load and baud rate." if often else (
        f"At least {_LEAST_STATE_RATE:g} per second must arrive: raise the autopilot's rate of ODOMETRY."
    )  # fmt: skip
    beats = heartbeat <= limits.heartbeat_age
    mode = f"{'armed' if sample.armed else 'disarmed'}, {'' if sample.offboard else 'not '}in OFFBOARD"
    standing = not sample.armed or limits.join_armed
    return [
        Check("vehicle state", f"{rate:.0f} per second, the newest {1e3 * age:.0f} ms old", fresh, advice),
        Check("heartbeat", f"{heartbeat:.1f} s ago", beats, "Check mavlink.system and the cable."),
        Check(
            "vehicle mode", mode, standing, "Disarm: a node that starts in the air stays silent until it has landed."
        ),
    ]


def _dropped(link: VehicleLink) -> Iterator[Check]:
    if link.dropped:
        found = ", ".join(f"{count} x {what}" for what, count in link.dropped.items())
        advice = "Let the autopilot send its position in MAV_FRAME_LOCAL_NED or LOCAL_FRD, and only when it has one."
        yield Check("unusable messages", found, False, advice, required=False)


def _points(
    lidar: PointSource, count: int, per_sweep: float, age: float, dropped: int, onboard: OnboardConfig
) -> list[Check]:
    counters = lidar.counters
    if not counters.packets:
        advice = (
            "Check the cable, the sensor's power, and that its host address and lidar.port are this computer's "
            f"(port {onboard.lidar.port}); {counters.bad} packets were refused."
        )
        return [Check("LiDAR", "nothing arrived", False, advice)]
    lost = counters.lost / max(counters.packets + counters.lost, 1)
    dense = per_sweep >= _LEAST_POINTS
    fresh = age <= onboard.limits.cloud_age
    placed = 1.0 - dropped / max(count, 1)
    newest = f"the newest point is {1e3 * age:.0f} ms old" if count else "no points: covered, or nothing is in range"
    return [
        Check("LiDAR", f"{per_sweep:.0f} points per sweep", dense,
              "Uncover the sensor, check its mode, and fly only where something is in range (40 m) all the time."),
        Check("cloud", newest, fresh, "Check the sensor's clock and the cable."),
        Check("packets", f"{counters.packets}, lost {100.0 * lost:.1f} %, refused {counters.bad}", lost <= _MOST_LOST,
              "Give the sensor a cable of its own, and a larger receive buffer."),
        Check("deskewing", f"{100.0 * placed:.0f} % of the points have a pose", placed > 0.8,
              "States must arrive at least every 0.25 s, with times that fit the host's clock."),
    ]  # fmt: skip


def _places(sample: VehicleSample | None, goal: ArrayLike | None, onboard: OnboardConfig) -> list[Check]:
    checks = []
    if sample is not None:
        position: NDArray[np.float64] = np.asarray(sample.state.position, dtype=np.float64)
        # On the ground the drone may be lower than it may fly.
        lifted = np.array([*position[:2], max(position[2], onboard.limits.fence_height_min)])
        checks.append(
            Check("position", _place(position), inside_fence(lifted, onboard.limits),
                  "It lies outside the geofence; correct limits.fence_*.")
        )  # fmt: skip
    if goal is None:
        advice = "Give one with --goal, or send it from the ground station; until then the node waits."
        return [*checks, Check("goal", "none yet", False, advice, required=False)]
    place = np.asarray(goal, dtype=np.float64)
    advice = "It lies outside the geofence; correct it or limits.fence_*."
    return [*checks, Check("goal", _place(place), inside_fence(place, onboard.limits), advice)]


def _place(position: NDArray[np.float64]) -> str:
    return "x {:.1f}, y {:.1f}, z {:.1f} m".format(*position)
