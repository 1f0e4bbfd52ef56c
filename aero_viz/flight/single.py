"""A single flight, headless and as fast as possible; optionally recorded while it is flown."""

from __future__ import annotations

import contextlib
import dataclasses
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from aero_planner import PlannerConfig, VehicleState
from aero_planner.config import DroneConfig
from aero_planner.mission_progress import MissionProgress
from aero_viz.errors import UserError
from aero_viz.flight.explanation import refuse_impossible
from aero_viz.flight.interrupt import FlightInterrupted, deferred_interrupt
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.flight.metrics import FlightResult
from aero_viz.flight.rules import FlightRules
from aero_viz.flight.source import FlightSource
from aero_viz.flight.state_noise import StateNoise
from aero_viz.flight.trajectory import trajectory_file
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.scenes.world import World
from aero_viz.sensors.models import LidarModel
from aero_viz.session import Session
from aero_viz.session.engine import PLANNER_FAILED
from aero_viz.session.frame import Frame

FlightProgress = Callable[[float, float], None]
"""Called with the share of the way to the goal that is covered, 0 to 1, and the simulated time [s]."""


class FlightRecorder(Protocol):
    """Receives a flight while it is flown, such as `aero_viz.logs.FlightLog`."""

    def write(self, frame: Frame) -> None:
        """Take the frame of a plan."""

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Take the true state at a time [s]: at the start and after every tick."""


class FlightRecorders:
    """A recorder that passes a flight on to several others."""

    def __init__(self, *recorders: FlightRecorder) -> None:
        self._recorders = recorders

    def write(self, frame: Frame) -> None:
        """Pass on the frame of a plan."""
        for recorder in self._recorders:
            recorder.write(frame)

    def write_pose(self, time: float, state: VehicleState) -> None:
        """Pass on the true state at a time [s]."""
        for recorder in self._recorders:
            recorder.write_pose(time, state)


def fly(
    world: World,
    *,
    config: DroneConfig | None = None,
    seed: int = 0,
    device: str = "cpu",
    lidar: LidarModel | None = None,
    vehicle: VehicleModel | None = None,
    rules: FlightRules | None = None,
    noise: StateNoise | None = None,
    speed: float | None = None,
    trajectory: str | Path | None = None,
    recorder: contextlib.AbstractContextManager[FlightRecorder] | None = None,
    config_name: str | None = None,
    progress: FlightProgress | None = None,
) -> FlightResult:
    """Fly once, headless and as fast as possible. Same seed and device, same flight, with or without a recorder.

    Args:
        world: where to fly.
        config: configuration, which also says which planner flies; None is the default of AERO-MPPI.
        seed: seed of LiDAR, noise and planner.
        device: Warp device.
        lidar, vehicle, rules, noise: as in `FlightBatch`.
        speed: replaces vehicle.speed_limit of the configuration [m/s].
        trajectory: CSV file to write during the flight, t,x,y,z,vx,vy,vz at the start and after every tick.
        recorder: context that is entered when the flight begins, and whose value receives it, such as
            `aero_viz.logs.flight_recorder(path)`.
        config_name: name of the configuration in the result; None is the name of an equal preset, or "custom".
        progress: called after every plan.

    Raises:
        FlightInterrupted: Ctrl-C was pressed. The exception holds the result so far, and all files are complete up to
            that tick.
        UserError: an option is out of range, no flight can arrive, the device does not exist, or a file cannot be
            written.
    """
    if not isinstance(world, World):
        raise UserError(f"world is {world!r}; it must be a World, such as aero_viz.scenes.scene('forest', seed=0).")
    config, rules = config or PlannerConfig(), rules or FlightRules()
    try:
        config = config if speed is None else config.replace({"vehicle.speed_limit": speed})
        name = config_name or config.preset_name
        refuse_impossible(world, rules=rules, speed_limit=config.vehicle.speed_limit, must_arrive=False)
        source = FlightSource(
            world,
            lidar=lidar,
            vehicle=vehicle.commanded_by(config) if vehicle else VehicleModel.from_config(config),
            rules=rules,
            noise=noise,
            control_step=config.control_step,
            seed=seed,
            device=device,
        )
        session = Session(source, config=config_for_flight(config, source.info), device=device, seed=seed)
    except ValueError as error:
        raise UserError(f"Cannot fly {world.name!r}: {error}") from error
    with contextlib.closing(session), contextlib.ExitStack() as stack:
        active_recorder = None if recorder is None else stack.enter_context(recorder)
        write_row = stack.enter_context(trajectory_file(trajectory))
        is_interrupted = stack.enter_context(deferred_interrupt())
        simulator, drone = source.simulator, source.simulator.vehicle

        def record_tick() -> None:
            arrays = (drone.position, drone.velocity, drone.quaternion)
            state = VehicleState(*(np.asarray(array.numpy()[0], dtype=np.float64) for array in arrays))
            write_row(simulator.time, state.position, state.velocity)
            if active_recorder is not None:
                active_recorder.write_pose(simulator.time, state)

        if active_recorder is not None or trajectory is not None:
            record_tick()
            simulator.observers.append(record_tick)
        plan_ms: list[float] = []
        failure: str | None = None
        ended = source.outcome is not None and active_recorder is None  # collided at the start: nothing to plan
        while not ended:
            frame = session.tick()
            plan_ms.append(frame.timings_ms["plan"])
            if active_recorder is not None:
                active_recorder.write(frame)
            if progress is not None:
                mission = frame.observation.mission or MissionProgress(world.route)
                progress(mission.share(world.start, frame.observation.actual_state.position), frame.time)
            ended = is_interrupted() or source.outcome is not None or frame.outcome is not None
            failure = frame.explanation if source.outcome is None and frame.outcome is not None else None
        median = statistics.median(plan_ms) if plan_ms else None
        result = dataclasses.replace(source.result(), config=name, plan_ms_median=median)
        if failure is not None:
            result = dataclasses.replace(result, reason=PLANNER_FAILED, explanation=failure)
        interrupted = is_interrupted()
    if interrupted:
        raise FlightInterrupted(result)
    return result
