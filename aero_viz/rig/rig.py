"""One flight of the onboard node against a simulated drone, in real time, over real sockets.

The simulation, autopilot, vehicle and LiDAR, runs in this process as one loop of 250 steps per second; the node runs in
a process of its own. The rig plays the pilot, who alone arms and switches to OFFBOARD, and the ground station that
sends the goal.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.onboard.frames import ned_from_world
from aero_planner.onboard.livox import CARTESIAN_MM
from aero_planner.onboard.mavlink import load_dialect
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.flight.simulator import FlightRules
from aero_viz.flight.vehicle import VehicleModel
from aero_viz.rig.autopilot import PERIOD, Mode, SimulatedAutopilot
from aero_viz.rig.faults import NETWORK, Fault
from aero_viz.rig.process import NodeProcess
from aero_viz.rig.result import Event, RigResult, Trajectory, intervals_of
from aero_viz.rig.sensor import SimulatedMid360
from aero_viz.scenes import World
from aero_viz.sensors.lidar import LidarModel, livox_mid360

__all__ = ["fly_rig"]

_CHECK_STEPS = 5  # between two looks for a collision
_REST_SPEED = 0.2  # [m/s]; slower counts as at rest
_REST_TIME = 2.0  # [s] of rest, or of arrival, that end a flight
_GOAL_PERIOD = 1.0  # [s] between two messages with the goal
_START_TIME = 60.0  # [s] for the node to start and stream: kernels are compiled the first time


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
    vehicle: VehicleModel | None = None,
    data_type: int = CARTESIAN_MM,
    state_pair: bool = False,
    loss_time: float = 0.5,
    shuttle: bool = False,
    command: Sequence[str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> RigResult:
    """Fly once, in real time.

    Args:
        world: where to fly.
        seed: of the LiDAR's pattern, of gusts and bad luck; timing is real, so that no two flights are equal.
        speed: replaces vehicle.speed_limit of the configuration [m/s]; None leaves it.
        faults: what goes wrong; network faults act on all wires.
        duration: longest flight [s].
        config: of the planner; None is the default.
        onboard: settings of the node; ports and mount are the rig's own. None is the default.
        lidar: None is the Mid-360.
        vehicle: None is the vehicle that the planner assumes.
        data_type: of the LiDAR's packets.
        state_pair: send LOCAL_POSITION_NED and ATTITUDE_QUATERNION instead of ODOMETRY.
        loss_time: time without setpoint after which the autopilot takes over, PX4's COM_OF_LOSS_T [s].
        shuttle: fly on, to the start and to the goal in turn, until the duration is over; that is an arrival then.
        command: what to run in the place of the node, see `NodeProcess`.
        progress: called with a sentence when something happens.

    Raises:
        ImportError: pymavlink is not installed.
        ValueError: the speed is out of range.
    """
    config = config or PlannerConfig()
    if speed is not None:
        config = config.replace({"vehicle.speed_limit": speed})
    lidar = lidar or livox_mid360()
    lidar_port, mavlink_port = _free_ports(2)
    changes: dict[str, Any] = {
        "lidar.host": "127.0.0.1", "lidar.port": lidar_port, "mavlink.url": f"udpin:127.0.0.1:{mavlink_port}",
    }  # fmt: skip
    for name, place, angle in zip("xyz", lidar.mount_position, lidar.mount_angles, strict=True):
        changes[f"lidar.mount_{name}"] = place
        changes[f"lidar.mount_{dict(x='roll', y='pitch', z='yaw')[name]}"] = angle
    onboard = (onboard or OnboardConfig()).replace(changes)
    model = vehicle or VehicleModel.from_config(config)
    toward = world.goal - world.start
    with contextlib.ExitStack() as stack:
        autopilot = SimulatedAutopilot(
            model,
            world.start,
            math.atan2(toward[1], toward[0]),
            ("127.0.0.1", mavlink_port),
            hover_thrust=onboard.thrust.hover_thrust,
            curve=onboard.thrust.curve,
            loss_time=loss_time,
            pair=state_pair,
            seed=seed,
        )
        stack.callback(autopilot.close)
        address = "127.0.0.1", lidar_port
        sensor = SimulatedMid360(world, lidar, address, period=PERIOD, seed=seed, data_type=data_type)
        stack.callback(sensor.close)
        node = NodeProcess(config, onboard, command=command)
        stack.callback(node.close)
        station = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        flight = _Flight(world, autopilot, sensor, node, faults, duration, shuttle, progress)
        flight.tell_goal = lambda goal: _send_goal(station, mavlink_port, goal)
        flight.run()
        node.stop()
        return flight.result(seed, 1.0 / onboard.rates.control)


class _Flight:
    """The loop and what it has seen."""

    tell_goal: Callable[[NDArray[np.float64]], None]

    def __init__(
        self,
        world: World,
        autopilot: SimulatedAutopilot,
        sensor: SimulatedMid360,
        node: NodeProcess,
        faults: Sequence[Fault],
        duration: float,
        shuttle: bool,
        progress: Callable[[str], None] | None,
    ) -> None:
        self._world, self._autopilot, self._sensor, self._node = world, autopilot, sensor, node
        self._waiting = sorted(faults, key=lambda fault: fault.at)
        self._faults, self._active = list(faults), list[Fault]()
        self._duration, self._shuttle, self._progress = duration, shuttle, progress
        self._goal, self._arrivals = world.goal, 0
        self._events: list[Event] = []
        self._engaged: float | None = None  # when the node was given the vehicle [s]
        self._rows: list[tuple[float, ...]] = []
        self._overruns = 0
        self._rest_since = self._near_since = math.inf
        self._mode = autopilot.mode
        self._reason = ""

    def run(self) -> None:
        """Fly until it is over."""
        self._note("node started")
        self._node.start()
        with _precedence():
            self._loop()

    def _loop(self) -> None:
        began = time.monotonic()
        self._autopilot.start()
        tick, told = 0, -math.inf
        while not self._reason:
            now = (tick + 1) * PERIOD
            wait = began + now - time.monotonic()
            if wait > 0.0:
                time.sleep(wait)
            elif wait < -PERIOD and self._engaged is not None:
                self._overruns += 1
            self._autopilot.step(tick, now)
            self._sensor.step(tick, self._autopilot.vehicle, now)
            if now - told >= _GOAL_PERIOD:
                self.tell_goal(self._goal)
                told = now
            if self._engaged is None:
                self._be_pilot(now)
            else:
                self._watch(tick, now - self._engaged)
            tick += 1

    def _be_pilot(self, now: float) -> None:
        """Arm and switch to OFFBOARD as soon as setpoints have been streaming for a while."""
        if not self._node.running:
            self._reason = "not_ready"
            self._note("node ended")
        elif now > _START_TIME:
            self._reason = "not_ready"
        elif self._autopilot.streaming:
            if not self._autopilot.armed:
                self._autopilot.arm()
                self._note("pilot arms")
            elif self._autopilot.engage():
                self._engaged = now
                self._mode = Mode.OFFBOARD
                self._note("pilot switches to OFFBOARD, autopilot accepts")

    def _watch(self, tick: int, now: float) -> None:
        """Record one step, time `now` after the engagement, and see whether something begins or ends."""
        autopilot = self._autopilot
        position, velocity = autopilot.position, autopilot.velocity
        offboard = autopilot.mode is Mode.OFFBOARD
        self._rows.append((now, *position, *velocity, float(offboard)))
        if autopilot.mode is not self._mode:
            self._mode = autopilot.mode
            self._note(f"autopilot leaves OFFBOARD: no setpoint for too long, {self._mode.name}", now)
        self._do_faults(now)
        moving = np.linalg.norm(velocity) > _REST_SPEED
        self._rest_since = math.inf if moving else min(self._rest_since, now)
        far = np.linalg.norm(position - self._goal) > FlightRules().arrival_radius
        self._near_since = math.inf if far else min(self._near_since, now)
        arrived = offboard and now - self._near_since >= _REST_TIME and not self._waiting
        self._arrivals += arrived
        if arrived and self._shuttle:
            self._goal = self._world.start if self._goal is self._world.goal else self._world.goal
            self.tell_goal(self._goal)
        resting = now - self._rest_since >= _REST_TIME
        if tick % _CHECK_STEPS == 0 and self._min_clearance(self._rows[-_CHECK_STEPS:]) < FlightRules().radius:
            self._end("collision", now)
        elif not np.all((position >= self._world.bounds[0]) & (position <= self._world.bounds[1])):
            self._end("out_of_bounds", now)
        elif arrived and not self._shuttle:
            self._end("arrived", now)
        elif resting and not offboard and not self._waiting and not self._restarting(now):
            self._end("held", now)
        elif now >= self._duration and self._shuttle and self._arrivals:
            self._end("arrived", now)
        elif now >= self._duration:
            self._end("stopped" if resting and offboard else "timeout", now)

    def _restarting(self, now: float) -> bool:
        """Whether a node that was killed may still come back and do harm."""
        return any(f.kind == "restart-node" and now < f.at + 10.0 for f in self._faults)

    def _end(self, reason: str, now: float) -> None:
        self._reason = reason
        self._note(reason, now)

    def _do_faults(self, now: float) -> None:
        while self._waiting and self._waiting[0].at <= now:
            fault = self._waiting.pop(0)
            self._note(f"fault: {fault}", now)
            if fault.kind == "restart-node":
                self._node.kill()
                self._node.start()
            else:
                self._active.append(fault)
                self._apply(fault, on=True)
        for fault in [fault for fault in self._active if fault.end <= now]:
            self._active.remove(fault)
            self._apply(fault, on=False)
            self._note(f"over: {fault.kind}", now)

    def _apply(self, fault: Fault, *, on: bool) -> None:
        if fault.kind in NETWORK:
            for wire in (self._autopilot.up, self._autopilot.down, self._sensor.channel):
                if on:
                    wire.active[fault.kind] = fault.amount or 0.0
                else:
                    wire.active.pop(fault.kind, None)
        elif fault.kind == "freeze-state":
            self._autopilot.frozen = on
        elif fault.kind == "kill-sensor":
            self._sensor.alive = not on
        elif on:
            self._node.pause()
        else:
            self._node.resume()

    def _note(self, what: str, now: float = 0.0) -> None:
        self._events.append(Event(None if self._engaged is None else now, what))
        if self._progress is not None:
            self._progress(f"{now:6.2f} s  {what}")

    def _min_clearance(self, rows: Sequence[tuple[float, ...]]) -> float:
        return float(self._world.distance(np.array(rows)[:, 1:4]).min())

    def result(self, seed: int, period: float) -> RigResult:
        """Return what was seen."""
        rows = np.array(self._rows) if self._rows else np.zeros((0, 8))
        trajectory = Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:7], rows[:, 7] > 0.0)
        length = float(np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum())
        flown = float(rows[-1, 0]) if len(rows) else 0.0
        clearance = self._min_clearance(self._rows) if self._rows else math.inf
        commands = self._autopilot.setpoints
        return RigResult(
            arrived=self._reason == "arrived",
            reason=self._reason,
            arrivals=self._arrivals,
            flight_time_s=flown,
            mean_speed=length / flown if flown else 0.0,
            max_speed=float(trajectory.speeds().max(initial=0.0)),
            min_clearance=clearance if math.isfinite(clearance) else None,
            scene=self._world.name,
            seed=seed,
            faults=[str(fault) for fault in self._faults],
            events=self._events,
            setpoints=sum(setpoint.mode is Mode.OFFBOARD for setpoint in commands),
            refused=self._autopilot.refused,
            trespasses=self._autopilot.trespasses,
            intervals=None if self._faults else intervals_of(commands, period),
            overruns=self._overruns,
            log=self._node.log(),
            trajectory=trajectory,
            commands=commands,
        )


@contextlib.contextmanager
def _precedence() -> Iterator[None]:
    """Let the simulation go before the node where this process may: the world outside waits for no computer."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, before - 10)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, before)


def _free_ports(count: int) -> list[int]:
    """Return UDP ports of this host that nobody uses now."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def _send_goal(station: socket.socket, port: int, goal: NDArray[np.float64]) -> None:
    """Send the goal as a ground station would, to the onboard computer."""
    d = load_dialect()
    protocol = d.MAVLink(None, srcSystem=255, srcComponent=190)
    ignore = 0b110111111000  # all but the position
    place = ned_from_world(goal).tolist()
    message = d.MAVLink_set_position_target_local_ned_message(
        0, 1, 191, d.MAV_FRAME_LOCAL_NED, ignore, *place, *[0.0] * 8
    )
    with contextlib.suppress(OSError):
        station.sendto(bytes(message.pack(protocol)), ("127.0.0.1", port))
