"""Preflight checks of the data that autopilot and LiDAR send."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.check_report import Check
from aero_planner.missions import Mission
from aero_planner.onboard.cloud_drift import measure_drift
from aero_planner.onboard.failsafe_conditions import is_inside_fence
from aero_planner.onboard.goal_tracker import named_places
from aero_planner.onboard.ground_tracker import GroundSource, GroundTracker
from aero_planner.onboard.interfaces import PointSource, VehicleLink, VehicleSample
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.sweep_buffer import SweepBuffer, make_sweep_buffer

_POLL_PERIOD = 0.01  # [s]
_MIN_STATE_RATE = 25.0  # [Hz]
_MIN_POINTS = 1000  # per sweep
_MAX_LOSS = 0.02  # fraction of packets
_MIN_FLOOR = 1.0  # [m] above a ground that no distance sensor measures
_MIN_PLACED = 0.8  # fraction of points


def check_inputs(
    link: VehicleLink,
    lidar: PointSource,
    onboard: OnboardConfig,
    *,
    goal: ArrayLike | Mission | None = None,
    listen: float = 3.0,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
) -> list[Check]:
    """Listen to autopilot and LiDAR and check their data.

    Args:
        link: Connection to the autopilot; nothing is commanded.
        lidar: The sensor.
        onboard: Configuration of the node.
        goal: [m], shape [3], world frame, or a mission; None expects a goal over the link.
        listen: Time to listen [s].
        clock: Host time [s].
        sleep: Waits for a time [s].
    """
    sweeps, ground = make_sweep_buffer(onboard), GroundTracker()
    states, points, newest_point = 0, 0, -math.inf
    last: VehicleSample | None = None
    start = clock()
    while clock() - start < listen:
        link.poll()
        sample = link.state
        if sample is not None and (last is None or sample.time > last.time):
            states += 1
            sweeps.add_pose(sample.time, sample.state.position, sample.state.quaternion)
            if sample.in_air is False and not sample.armed:
                ground.add_standing(float(np.asarray(sample.state.position)[2]))
            ground.add_range(sample.time, sample.ground_height)
        last = sample
        for packet in lidar.poll():
            points += len(packet.times)
            newest_point = max(newest_point, float(packet.times.max(initial=-math.inf)))
            sweeps.add_points(packet.points, packet.times)
        sleep(_POLL_PERIOD)
    now = clock()
    duration = now - start
    per_sweep = points / duration * onboard.lidar.sweep_period
    checks = [*_check_vehicle(last, states / duration, now, onboard), *_check_dropped(link)]
    unplaced = sweeps.dropped + sweeps.waiting
    checks += _check_points(lidar, points, per_sweep, now - newest_point, unplaced, onboard)
    checks += [_check_drift(sweeps, last, onboard)] if last is not None and points else []
    checks += [_check_ground(ground, onboard)] if last is not None else []
    checks += _check_positions(last, goal if goal is not None else link.goal, ground.height, onboard)
    return checks


def _check_vehicle(sample: VehicleSample | None, rate: float, now: float, onboard: OnboardConfig) -> list[Check]:
    if sample is None:
        advice = (
            "Check cable, mavlink.url, the autopilot's baud rate, and that it sends ODOMETRY or LOCAL_POSITION_NED and "
            "ATTITUDE_QUATERNION, for which it needs a position estimate."
        )
        if onboard.state.source == "ros":
            advice += f" {_arrives_in_ros(onboard.state.topic)}"
        return [Check("vehicle state", "nothing arrived", ok=False, advice=advice)]
    limits = onboard.limits
    age, heartbeat_age = now - sample.time, now - sample.heartbeat_time
    is_frequent = rate >= _MIN_STATE_RATE
    if is_frequent:
        advice = "The states are late: check the load and the baud rate of the link."
    else:
        advice = f"At least {_MIN_STATE_RATE:g} per second must arrive: raise the autopilot's rate of ODOMETRY."
    mode = f"{'armed' if sample.armed else 'disarmed'}, {'' if sample.offboard else 'not '}in OFFBOARD"
    return [
        Check(
            "vehicle state",
            f"{rate:.0f} per second, the newest {1e3 * age:.0f} ms old",
            ok=is_frequent and age <= limits.state_age,
            advice=advice,
        ),
        Check(
            "heartbeat",
            f"{heartbeat_age:.1f} s ago",
            ok=heartbeat_age <= limits.heartbeat_age,
            advice="Check mavlink.system and the cable.",
        ),
        _check_round_trip(sample, limits.round_trip),
        Check(
            "vehicle mode",
            mode,
            ok=not sample.armed or limits.join_armed,
            advice="Disarm: a node that starts in the air stays silent until the drone has landed.",
        ),
        _check_landed_state(sample),
        *_check_uncertainty(sample, onboard),
        _check_fix(sample, now, onboard),
        *_check_reserves(sample),
    ]


def _check_round_trip(sample: VehicleSample, limit: float) -> Check:
    name, round_trip = "round trip", sample.round_trip
    if math.isnan(round_trip):
        advice = "A late link is not noticed: let the autopilot answer TIMESYNC, and set mavlink.state_rate above 0."
        return Check(name, "not measured", ok=False, required=False, advice=advice)
    advice = f"At most {1e3 * limit:g} ms are accepted (limits.round_trip): use a faster link, and one without buffers."
    return Check(name, f"{1e3 * round_trip:.0f} ms to the autopilot and back", ok=round_trip <= limit, advice=advice)


def _check_landed_state(sample: VehicleSample) -> Check:
    words = {None: "not reported", True: "in the air", False: "on the ground, taking off or landing"}
    advice = (
        "The node is READY only in the air, as reported by EXTENDED_SYS_STATE: let the autopilot send it, and set "
        "mavlink.state_rate above 0 so that the node requests it."
    )
    return Check("landed state", words[sample.in_air], ok=sample.in_air is not None, advice=advice)


def _check_reserves(sample: VehicleSample) -> Iterator[Check]:
    words = {None: "not reported", True: "heard by the autopilot", False: "lost"}
    advice = (
        "Switch it on. The node stops when the autopilot reports its loss by SYS_STATUS: set mavlink.state_rate above "
        "0 so that the node requests it."
    )
    yield Check("transmitter", words[sample.transmitter], ok=sample.transmitter is True, advice=advice)
    if sample.battery_low:
        yield Check("battery", "low, says the autopilot", ok=False, advice="Charge it.")


def _check_uncertainty(sample: VehicleSample, onboard: OnboardConfig) -> Iterator[Check]:
    limits = onboard.limits
    quantities = (
        ("position uncertainty", sample.position_std, limits.position_std, "m"),
        ("velocity uncertainty", sample.velocity_std, limits.velocity_std, "m/s"),
    )
    for name, std, limit, unit in quantities:
        if math.isnan(std):
            advice = "A lost position would not be noticed: let the autopilot send ODOMETRY with its covariances."
            yield Check(name, "not reported", ok=False, required=False, advice=advice)
        else:
            advice = f"The node flies with at most {limit:g} {unit}: wait for a better estimate, and check its sources."
            yield Check(name, f"{std:.2f} {unit} (standard deviation)", ok=std <= limit, advice=advice)


def _check_fix(sample: VehicleSample, now: float, onboard: OnboardConfig) -> Check:
    if math.isnan(sample.fix_time):
        advice = (
            "If the drone depends on GNSS, wait for a fix, and let the autopilot send GPS_RAW_INT: without it, a lost "
            "position is noticed seconds late, by the uncertainty alone."
        )
        return Check("GNSS fix", "not reported", ok=False, required=False, advice=advice)
    age, limit = now - sample.fix_time, onboard.limits.fix_age
    advice = f"The node flies while a fix is at most {limit:g} s old: wait for one, and check antenna and sky."
    return Check("GNSS fix", f"{age:.1f} s ago", ok=age <= limit, advice=advice)


def _check_dropped(link: VehicleLink) -> Iterator[Check]:
    if link.dropped:
        finding = ", ".join(f"{count} x {reason}" for reason, count in link.dropped.items())
        advice = "Let the autopilot send its position in MAV_FRAME_LOCAL_NED or LOCAL_FRD, and only when it has one."
        yield Check("unusable messages", finding, ok=False, required=False, advice=advice)
    if link.ignored:
        finding = ", ".join(f"{count} x {what}" for what, count in link.ignored.items())
        advice = "Name the senders of goals in mavlink.goal_senders; find out who poses as the autopilot."
        yield Check("ignored messages", finding, ok=False, required=False, advice=advice)


def _arrives_in_ros(topic: str) -> str:
    return f"Check that ros2 topic hz {topic} counts messages on this computer, in the same ROS_DOMAIN_ID."


def _check_points(
    lidar: PointSource, count: int, per_sweep: float, age: float, unplaced: int, onboard: OnboardConfig
) -> list[Check]:
    counters = lidar.counters
    if not counters.packets:
        advice = (
            "Check the cable, the sensor's power, and that its host address and lidar.port are those of this computer "
            f"(port {onboard.lidar.port})"
        )
        if onboard.lidar.source == "ros":
            advice = _arrives_in_ros(onboard.lidar.topic).rstrip(".")
        advice += f"; {counters.bad} packets were refused."
        return [Check("LiDAR", "nothing arrived", ok=False, advice=advice)]
    loss = counters.lost / max(counters.packets + counters.lost, 1)
    placed = 1.0 - unplaced / max(count, 1)
    newest = f"the newest point is {1e3 * age:.0f} ms old" if count else "no points: covered, or nothing is in range"
    return [
        Check(
            "LiDAR",
            f"{per_sweep:.0f} points per sweep",
            ok=per_sweep >= _MIN_POINTS,
            advice="Uncover the sensor, check its mode, and fly only where something is in range (40 m) all the time.",
        ),
        Check("cloud", newest, ok=age <= onboard.limits.cloud_age, advice="Check the sensor's clock and the cable."),
        Check(
            "packets",
            f"{counters.packets}, lost {100.0 * loss:.1f} %, refused {counters.bad}",
            ok=loss <= _MAX_LOSS,
            advice="Give the sensor a dedicated network port, and enlarge the receive buffer.",
        ),
        Check(
            "deskewing",
            f"{100.0 * placed:.0f} % of the points have a pose",
            ok=placed > _MIN_PLACED,
            advice="States must arrive at least every 0.25 s, with times that fit the host's clock.",
        ),
    ]


def _check_drift(sweeps: SweepBuffer, sample: VehicleSample, onboard: OnboardConfig) -> Check:
    older, newer, interval = sweeps.newest_pair()
    drift = measure_drift(older, newer, np.asarray(sample.state.position, dtype=np.float64))
    name, limits = "cloud against itself", onboard.limits
    if drift is None:
        advice = "Too little is visible to measure whether the estimate drifts."
        return Check(name, "not measured", ok=False, required=False, advice=advice)
    angle, speed = math.degrees(drift.angle), drift.shift / interval
    advice = (
        f"While the drone stands still, at most {limits.drift_angle:g} deg and {limits.drift_speed:g} m/s are "
        "accepted: check the autopilot's estimate, and lidar.mount_* if it happens only while the drone is turned."
    )
    is_still = angle <= limits.drift_angle and speed <= limits.drift_speed
    return Check(name, f"moves {speed:.2f} m/s and turns {angle:.1f} deg in {interval:g} s", ok=is_still, advice=advice)


def _check_ground(ground: GroundTracker, onboard: OnboardConfig) -> Check:
    floor = onboard.limits.fence_height_min
    finding = f"at a height of {ground.height:.2f} m, {ground.source.value}; the floor is {floor:g} m above it"
    advice = (
        f"The autopilot's height may be wrong by a metre, and no distance sensor measures it (DISTANCE_SENSOR): keep "
        f"limits.fence_height_min at {_MIN_FLOOR:g} m or more."
    )
    is_certain = ground.source is GroundSource.RANGE or floor >= _MIN_FLOOR
    return Check("ground", finding, ok=is_certain, required=False, advice=advice)


def _check_positions(
    sample: VehicleSample | None, goal: ArrayLike | Mission | None, ground: float, onboard: OnboardConfig
) -> list[Check]:
    checks = []
    outside = "It lies outside the geofence; correct limits.fence_*."
    if sample is not None:
        position: NDArray[np.float64] = np.asarray(sample.state.position, dtype=np.float64)
        # On the ground the drone may be below the geofence.
        lifted = np.array([*position[:2], max(position[2], ground + onboard.limits.fence_height_min)])
        is_inside = is_inside_fence(lifted, onboard.limits, ground=ground)
        checks.append(Check("position", _format_position(position), ok=is_inside, advice=outside))
    if goal is None:
        advice = "Give one with --goal, or send it from the ground station; until then the node waits."
        return [*checks, Check("goal", "none yet", ok=False, required=False, advice=advice)]
    advice = "It lies outside the geofence; correct it or limits.fence_*."
    for name, place in named_places(goal if isinstance(goal, Mission) else np.asarray(goal, dtype=np.float64)):
        is_inside = is_inside_fence(place, onboard.limits, ground=ground)
        checks.append(Check(name, _format_position(np.array(place)), ok=is_inside, advice=advice))
    return checks


def _format_position(position: NDArray[np.float64]) -> str:
    return "x {:.1f}, y {:.1f}, z {:.1f} m".format(*position)
