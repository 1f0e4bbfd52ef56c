"""One flight of the onboard node against a simulated drone, in real time, over real sockets.

The simulation of autopilot, vehicle and LiDAR runs in this process as one loop of 250 steps per second. The node runs
in a separate process. The rig also plays the pilot, who alone arms and switches to OFFBOARD, and the ground station,
which sends the goal.
"""

from __future__ import annotations

import contextlib
import math
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import Planner, PlannerConfig
from aero_planner.onboard.connections import thrust_model
from aero_planner.onboard.frames import ned_from_world
from aero_planner.onboard.known_drone import config_on_drone
from aero_planner.onboard.livox import CARTESIAN_MM
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.errors import UserError
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.autopilot import PERIOD, SimulatedAutopilot
from aero_viz.rig.faults import OWN_FAULTS, Fault
from aero_viz.rig.flight import RigFlight
from aero_viz.rig.lockstep_node import LockstepNode
from aero_viz.rig.process import NodeProcess
from aero_viz.rig.px4_autopilot import Px4Autopilot
from aero_viz.rig.px4_log import load_reader, summarize_log
from aero_viz.rig.px4_process import HOST, Px4Process
from aero_viz.rig.px4_setup import set_parameters
from aero_viz.rig.result import RigResult
from aero_viz.rig.sensor import SimulatedMid360
from aero_viz.scenes import World
from aero_viz.sensors.models import LIDARS, LidarModel

PX4_RESPONSE: dict[str, Any] = {
    "rate_lag": 0.07,
    "thrust_lag": 0.045,
    "drag": 0.3,
    "rate_xy_max": 3.84,
    "rate_z_max": 0.8,
}
"""Response of the vehicle to setpoints, as identified from flights of PX4 1.17 in its own simulation: parameters of
`VehicleModel`. The largest rates are those of PX4's attitude controller about x and y (MC_ROLLRATE_MAX), and what the
motors reach about z."""

_LOCKSTEP_SPEED = 0.25  # of PX4's simulation in lockstep
_START_HEIGHT = 2.0  # [m] of the start above the ground in a world without ground
_STAND = 0.1  # [m] height of the vehicle's centre above the ground on which it stands


def fly_rig(
    world: World,
    *,
    seed: int = 0,
    speed: float | None = 5.0,
    faults: Sequence[Fault] = (),
    duration: float = 60.0,
    config: PlannerConfig | None = None,
    onboard: OnboardConfig | None = None,
    lidar: LidarModel | None = None,
    data_type: int = CARTESIAN_MM,
    state_pair: bool = False,
    loss_time: float | None = None,
    shuttle: bool = False,
    lockstep: bool = False,
    px4: str | Path | None = None,
    px4_parameters: Mapping[str, float] | None = None,
    command: Sequence[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> RigResult:
    """Fly once, in real time.

    Args:
        world: where to fly.
        seed: seed of the LiDAR's pattern, of gusts and of the faults. Two flights with the same seed still differ,
            because timing is real.
        speed: speed limit [m/s], overrides vehicle.speed_limit of the configuration; None keeps that.
        faults: faults to inject; network faults affect all connections.
        duration: longest flight [s].
        config: configuration of the planner; None is the default.
        onboard: settings of the node; None is the default. The rig replaces ports and the LiDAR's mount.
        lidar: None is the Mid-360.
        data_type: data type of the LiDAR's packets, see `aero_planner.onboard.livox`.
        state_pair: send LOCAL_POSITION_NED and ATTITUDE_QUATERNION instead of ODOMETRY.
        loss_time: time without setpoints after which the autopilot takes over, PX4's COM_OF_LOSS_T [s]. None is 0.5 s,
            and with PX4 what preflight sets.
        shuttle: fly back and forth between start and goal until the duration is over. The flight counts as arrived if
            it reaches one of them at least once.
        lockstep: run the node and the failsafe process's code in this process and in simulated time, in which a plan
            takes 20 ms: the result depends little on the load of the machine, and with the rig's own autopilot not at
            all.
        px4: folder of PX4's sources with a build of its simulation, which replaces the rig's own autopilot and vehicle.
        px4_parameters: PX4's parameters to set, besides those that preflight wants.
        command: command to run instead of the node, see `NodeProcess`.
        progress: called with a sentence when something happens.

    Raises:
        ImportError: pymavlink is not installed.
        UserError: there is no PX4 in the folder, it does not start, it does not accept a parameter, a fault is one
            of `OWN_FAULTS`, or pyulog is not installed.
        ValueError: the speed is out of range.
    """
    if px4 is not None and (own := [fault.kind for fault in faults if fault.kind in OWN_FAULTS]):
        raise UserError(f"The fault {own[0]} needs the rig's own autopilot; fly without PX4.")
    config = config or PlannerConfig()
    if speed is not None:
        config = config.replace({"vehicle.speed_limit": speed})
    lidar = lidar or LIDARS["mid360"]
    lidar_port, mavlink_port = free_ports(2)
    onboard = (onboard or OnboardConfig()).replace(rig_settings(lidar, lidar_port, mavlink_port))
    with contextlib.ExitStack() as stack:
        process = None
        if px4 is not None:
            load_reader()  # rather than after the flight, whose result would be lost
            process = stack.enter_context(
                contextlib.closing(Px4Process(px4, speed=_LOCKSTEP_SPEED if lockstep else 1.0))
            )
        if process is None:
            autopilot = _simulated_autopilot(
                world,
                config,
                onboard,
                port=mavlink_port,
                loss_time=loss_time or 0.5,
                pair=state_pair,
                lockstep=lockstep,
                seed=seed,
            )
        else:
            onboard = onboard.replace({"mavlink.system": process.system})
            parameters = dict(px4_parameters or {}) | ({} if loss_time is None else {"COM_OF_LOSS_T": loss_time})
            autopilot = _px4_autopilot(
                process,
                world,
                config,
                onboard,
                port=mavlink_port,
                parameters=parameters,
                lockstep=lockstep,
                seed=seed,
            )
        close_autopilot = stack.enter_context(contextlib.ExitStack())
        close_autopilot.callback(autopilot.close)
        sensor = SimulatedMid360(world, lidar, (HOST, lidar_port), period=PERIOD, seed=seed, data_type=data_type)
        stack.callback(sensor.close)
        if lockstep:
            planner = stack.enter_context(contextlib.closing(Planner(config_on_drone(config, onboard), device="cpu")))
            node = LockstepNode(planner, onboard, clock=lambda: flight.now, advance=lambda time: flight.advance(time))
        else:
            node = NodeProcess(config, onboard, command=command)
        stack.callback(node.close)
        station = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        flight = RigFlight(
            world,
            autopilot,
            sensor,
            node,
            send_goal=lambda goal: _send_goal(station, mavlink_port, autopilot.local(goal), onboard.mavlink.system),
            faults=faults,
            duration=duration,
            shuttle=shuttle,
            progress=progress,
        )
        flight.run()
        node.stop()
        result = flight.result(seed, 1.0 / onboard.rates.control)
        if process is None:
            return result
        close_autopilot.close()  # ends PX4's log
        log = process.stop()
        return result.with_log(None if log is None else summarize_log(log))


def _simulated_autopilot(
    world: World,
    config: PlannerConfig,
    onboard: OnboardConfig,
    *,
    port: int,
    loss_time: float,
    pair: bool,
    lockstep: bool,
    seed: int,
) -> SimulatedAutopilot:
    direction = world.goal - world.start
    return SimulatedAutopilot(
        VehicleModel.from_config(config, **PX4_RESPONSE),
        world.start,
        math.atan2(direction[1], direction[0]),
        (HOST, port),
        hover_thrust=onboard.thrust.hover_thrust,
        curve=onboard.thrust.curve,
        loss_time=loss_time,
        pair=pair,
        ground=ground_below(world),
        lockstep=lockstep,
        seed=seed,
    )


def _px4_autopilot(
    process: Px4Process,
    world: World,
    config: PlannerConfig,
    onboard: OnboardConfig,
    *,
    port: int,
    parameters: Mapping[str, float],
    lockstep: bool,
    seed: int,
) -> Px4Autopilot:
    ground, direction = ground_below(world), world.goal - world.start
    origin = np.array([world.start[0], world.start[1], world.start[2] - _START_HEIGHT if ground is None else ground])
    height = float(world.start[2] - origin[2])
    set_parameters(process, onboard, config.vehicle, {"MIS_TAKEOFF_ALT": height, **parameters})
    return Px4Autopilot(
        process,
        (HOST, port),
        origin=origin,
        heading=math.atan2(direction[1], direction[0]),
        thrust=thrust_model(onboard, config.vehicle),
        lockstep=lockstep,
        seed=seed,
    )


def ground_below(world: World) -> float | None:
    """Return the height of the surface below the start [m], or None if there is none within 20 m."""
    place = world.start.astype(np.float64)
    for _ in range(1000):
        distance = float(world.distance(place[None])[0])
        if distance < _STAND:
            return float(place[2])
        place[2] -= distance - 0.5 * _STAND
        if place[2] < world.start[2] - 20.0:
            break
    return None


def rig_settings(lidar: LidarModel, lidar_port: int, mavlink_port: int) -> dict[str, Any]:
    """Return the node's settings that depend on the rig, by path."""
    mount = zip(("x", "y", "z", "roll", "pitch", "yaw"), lidar.mount_position + lidar.mount_angles, strict=True)
    return {
        "lidar.host": HOST,
        "lidar.port": lidar_port,
        "mavlink.url": f"udpin:{HOST}:{mavlink_port}",
        "mavlink.goal_senders": f"255@{HOST}",
        **{f"lidar.mount_{name}": value for name, value in mount},
    }


def free_ports(count: int) -> list[int]:
    """Return UDP ports of this host that are not in use now."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
        for probe in sockets:
            probe.bind((HOST, 0))
        return [probe.getsockname()[1] for probe in sockets]


def _send_goal(station: socket.socket, port: int, goal: NDArray[np.float64], system: int) -> None:
    """Send the goal [m], shape [3], local frame, to the onboard computer of `system`, as a ground station would."""
    dialect = load_dialect()
    protocol = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    ignored_fields = 0b110111111000  # all but the position
    position = ned_from_world(goal).tolist()
    message = dialect.MAVLink_set_position_target_local_ned_message(
        0, system, 191, dialect.MAV_FRAME_LOCAL_NED, ignored_fields, *position, *[0.0] * 8
    )
    with contextlib.suppress(OSError):
        station.sendto(bytes(message.pack(protocol)), (HOST, port))
