"""A simulated flight as a drone's recorder would write it: raw sweeps with a time per point, IMU, odometry, plan."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig
from aero_planner.onboard.ros_definitions import DEFINITIONS
from aero_planner.onboard.ros_messages import BODY, Encoded, goal_message, plan_messages, pose_messages, sweep
from aero_planner.output_files import open_alone
from aero_planner.pose_track import PoseTrack
from aero_planner.quaternions import conjugate, multiply, rotate, rotation_vector, slerp
from aero_viz.errors import UserError
from aero_viz.flight import FlightRules, FlightSource
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.flight.metrics import FlightResult
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.recordings.imu_messages import IMU_TYPE, encode_imu
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session

_GRAVITY = np.array([0.0, 0.0, 9.81])
_ACCELERATION_NOISE, _RATE_NOISE = 0.05, 0.002  # standard deviations [m/s^2], [rad/s]


@dataclasses.dataclass(frozen=True)
class SensorLogOptions:
    """Contents of a sensor log."""

    start: int = 1_700_000_000_000_000_000
    """Stamp of source time 0 [ns]."""
    every: int = 1
    """Every `every`-th ray is written."""
    resolution: float = 0.0
    """Coordinates are rounded to multiples of this [m]; 0 keeps them. Powers of two compress best."""
    time_resolution: float = 1e-9
    """The times of the points are rounded down to multiples of this [s]."""
    imu: bool = False
    """True writes /imu at every tick of the rules, with the noise of a small MEMS sensor."""
    pose_every: int = 1
    """/odometry and /tf are written every `pose_every`-th tick; 0 writes none."""
    plan_period: float | None = 0.2
    """Time between two plans in the file [s]; None writes no plan and no goal."""
    hover: float = 0.0
    """Time for which the drone hovers before it flies [s]."""
    duration: float = float("inf")
    """The flight is cut after this time [s]."""


def write_sensor_log(
    world: World,
    path: str | Path,
    *,
    config: DroneConfig | None = None,
    seed: int = 0,
    speed: float | None = None,
    lidar: LidarModel | None = None,
    rules: FlightRules | None = None,
    options: SensorLogOptions | None = None,
) -> FlightResult:
    """Fly once and write an MCAP file. The same arguments give the same file, byte for byte.

    Args:
        world: where to fly.
        path: file to write; an existing file is replaced.
        config: configuration of the planner; None is the default.
        seed: seed of LiDAR, noise and planner.
        speed: replaces vehicle.speed_limit of the configuration [m/s].
        lidar: model of the LiDAR, mounted at the body's origin; None is the Mid-360.
        rules: when the flight ends; the period is that of the poses and the IMU.
        options: what to write.

    Raises:
        UserError: the file cannot be written.
    """
    config, rules, options = config or PlannerConfig(), rules or FlightRules(), options or SensorLogOptions()
    config = config if speed is None else config.replace({"vehicle.speed_limit": speed})
    source = FlightSource(
        world,
        lidar=lidar,
        vehicle=VehicleModel.from_config(config),
        rules=rules,
        control_step=config.control_step,
        seed=seed,
    )
    try:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open_alone(path))
            log = _SensorLog(Writer(file, compression=CompressionType.ZSTD), source, options, seed)
            source.simulator.observers.append(log.write_tick)
            vehicle: Any = source.simulator.vehicle
            hover: Any = SimpleNamespace(command=vehicle.recent_commands.numpy()[0, [0, 0]], model=vehicle.model.model)
            while source.simulator.time < options.hover - 1e-9:
                source.advance(hover)
            session = Session(source, config=config_for_flight(config, source.info), seed=seed)
            stack.callback(session.close)
            while source.outcome is None and source.simulator.time < options.duration:
                frame = session.tick()
                log.write_plan(frame.observation.goal, frame.plan)
            result = source.result()
            log.finish(world, result)
            return result
    except OSError as error:
        raise UserError(f"Cannot write {path}: {error.strerror or error}.") from error


class _SensorLog:
    """Writes the ticks of a flight.

    Args:
        writer: a new MCAP writer.
        source: the flight.
        options: what to write.
        seed: seed of the noise of the IMU.
    """

    def __init__(self, writer: Writer, source: FlightSource, options: SensorLogOptions, seed: int) -> None:
        self._writer, self._simulator, self._options = writer, source.simulator, options
        self._channels: dict[str, int] = {}
        self._parts: list[tuple[NDArray[np.float32], NDArray[np.float64]]] = []
        self._next_plan = 0.0
        self._random = np.random.default_rng(seed)
        self._stamp = options.start
        writer.start(profile="ros2", library="aero-viz")
        self._state = self._read_state()
        self._write_pose()

    def write_tick(self) -> None:
        """Write the pose, the IMU and, at the end of a sweep, the sweep. An observer of the simulator."""
        before = self._state
        self._state = self._read_state()
        self._stamp = self._options.start + round(1e9 * self._simulator.time)
        self._write_pose()
        if self._options.imu:
            self._write_imu(before)
        self._add_scan(before)

    def write_plan(self, goal: Any, plan: Any) -> None:
        """Write the goal once and a plan if it is due."""
        period = self._options.plan_period
        if period is None or self._simulator.time < self._next_plan - 1e-9:
            return
        if self._next_plan == 0.0:
            self._add(goal_message(goal, self._stamp))
        self._next_plan += period
        for message in plan_messages(plan, self._stamp, plan_ms=0.0, lines=False):
            self._add(message)

    def finish(self, world: World, result: FlightResult) -> None:
        """Write the world and the outcome, and close the file."""
        settings = {"scene": world.name, **result.to_dict()}
        settings.pop("plan_ms_median", None)
        rounded = _rounded(world.to_dict())
        for name, content in (("world.json", rounded), ("outcome.json", settings)):
            text = json.dumps(content, allow_nan=False, separators=(",", ":")).encode()
            self._writer.add_attachment(self._stamp, self._options.start, name, "application/json", text)
        self._writer.finish()

    def _read_state(self) -> Any:
        from aero_planner import VehicleState

        drone = self._simulator.vehicle
        arrays = (drone.position, drone.velocity, drone.quaternion)
        return VehicleState(*(array.numpy()[0].astype(np.float64) for array in arrays), time=self._simulator.time)

    def _write_pose(self) -> None:
        every = self._options.pose_every
        if every and self._simulator.tick % every == 0:
            for message in pose_messages(self._state, self._stamp):
                self._add(message)

    def _write_imu(self, before: Any) -> None:
        """Write the mean specific force and body rates of a tick, with the stamp of its middle."""
        after, period = self._state, self._simulator.rules.period
        attitude = slerp(before.quaternion, after.quaternion, 0.5)
        force = rotate(conjugate(attitude), (after.velocity - before.velocity) / period + _GRAVITY)
        rates = rotation_vector(multiply(conjugate(before.quaternion), after.quaternion)) / period
        force = force + self._random.normal(0.0, _ACCELERATION_NOISE, 3)
        rates = rates + self._random.normal(0.0, _RATE_NOISE, 3)
        stamp = self._stamp - round(0.5e9 * period)
        self._add(Encoded("/imu", IMU_TYPE, encode_imu(stamp, BODY, rates, force)), stamp)

    def _add_scan(self, before: Any) -> None:
        """Collect the points of a tick in the body frame at their own times, and write a complete sweep."""
        simulator, options = self._simulator, self._options
        size = simulator.lidar.model.points_per_sweep
        _, part, parts = simulator.part_of_sweep(simulator.tick - 1)
        first, end = part * size // parts, (part + 1) * size // parts
        rays = np.arange(first, end)
        rays = rays[rays % options.every == 0]
        world: Any = simulator.lidar.points.numpy()[0, rays]
        times = (rays + 0.5) / size / (simulator.lidar.model.sweep_rate * simulator.ticks_per_sweep / parts)
        start = part * simulator.rules.period
        after = self._state
        track = PoseTrack.from_arrays(
            [start, start + simulator.rules.period],
            [before.position, after.position],
            [before.quaternion, after.quaternion],
        )
        positions, quaternions = track.interpolate(times)
        points = rotate(conjugate(quaternions), world - positions).astype(np.float32)
        if options.resolution:
            points = np.round(points / options.resolution).astype(np.float32) * np.float32(options.resolution)
        hit = np.isfinite(points).all(axis=1)
        self._parts.append((points[hit], times[hit]))
        if part == parts - 1:
            points, times = (np.concatenate(arrays) for arrays in zip(*self._parts, strict=True))
            self._parts = []
            stamp = self._stamp - round(1e9 * simulator.rules.period * parts)
            step = options.time_resolution
            times = np.round(np.floor(times / step + 1e-6) * step * 1e9).astype(np.uint32)
            self._add(sweep(points, stamp, times=times), self._stamp)

    def _add(self, message: Encoded, time: int | None = None) -> None:
        if message.topic not in self._channels:
            schema = self._writer.register_schema(message.kind, "ros2msg", _definition(message.kind).encode())
            self._channels[message.topic] = self._writer.register_channel(message.topic, "cdr", schema)
        stamp = self._stamp if time is None else time
        self._writer.add_message(self._channels[message.topic], stamp, message.data, stamp)


def _rounded(value: Any) -> Any:
    """Return the content of a JSON file with numbers rounded to 0.1 mm, which takes a third of the space."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return round(value, 4) if isinstance(value, float) else value


@cache
def _typestore() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _definition(kind: str) -> str:
    return DEFINITIONS[kind] if kind in DEFINITIONS else _typestore().generate_msgdef(kind, ros_version=2)[0]
