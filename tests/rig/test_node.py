"""The node itself on the rig, in real time: what it does with the vehicle, whatever is done to it.

How fast a flight goes depends on the machine; where it ends and what the node never does must not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.livox import CARTESIAN_CM
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.rig import Fault, RigResult, fly_rig
from aero_viz.rig.autopilot import Mode
from aero_viz.scenes import World
from aero_viz.sensors.lidar import LidarModel

pytestmark = pytest.mark.realtime

CONFIG = PlannerConfig.preset("fast-cpu")
ONBOARD = OnboardConfig().replace({"telemetry.enabled": False, "limits.hold_time": 2.0})


@pytest.fixture
def world() -> World:
    posts = [[x, y, 0, 0, 0, 1, 0.3, 8] for x, y in ((6, 0.5), (10, -3), (10, 3), (14, -1), (19, 1))]
    ground = [10.0, 0, -0.5, 80, 80, 1, 0]
    return World("posts", np.array([0.0, 0, 2]), np.array([12.0, 0, 2]), np.array(posts), np.array([ground]))


def fly(world: World, *faults: Fault, **options: Any) -> RigResult:
    options = {"onboard": ONBOARD} | options
    result = fly_rig(world, config=CONFIG, speed=3.0, faults=faults, duration=30.0, **options)
    assert result.setpoints > 0, result.log
    # What must hold in every flight.
    assert result.trespasses == []
    assert result.refused == 0 or any(fault.kind == "corrupt" for fault in faults)
    assert result.reason != "collision", (result, result.log)
    return result


def obeyed_after(result: RigResult, time: float) -> list[float]:
    """Return when setpoints were obeyed later than `time` after the engagement [s]."""
    began = next(c.time for c in result.commands if c.mode is Mode.OFFBOARD)
    return [c.time - began for c in result.commands if c.mode is Mode.OFFBOARD and c.time - began > time]


def test_it_flies_between_posts_to_the_goal(world):
    result = fly(world)
    assert result.arrived, (result, result.log)
    assert result.max_speed < 4.5


def test_the_other_packets_messages_and_a_mounted_sensor_do_as_well(world):
    lidar = LidarModel("mid360", mount_angles=(0.0, 20.0, 0.0), mount_position=(0.1, 0.0, 0.05))
    result = fly(world, data_type=CARTESIAN_CM, state_pair=True, lidar=lidar)
    assert result.arrived, (result, result.log)


def test_without_points_it_stops_and_hands_back(world):
    result = fly(world, Fault("kill-sensor", 1.5))
    assert result.reason == "held", (result, result.log)
    # Points may be half a second old; then it brakes from 3 m/s.
    assert result.trajectory.speeds()[result.trajectory.times > 5.0].max() < 0.5


def test_without_states_it_stops_by_dead_reckoning_and_hands_back(world):
    result = fly(world, Fault("freeze-state", 1.5, 20.0))
    assert result.reason == "held", (result, result.log)
    limits = ONBOARD.limits
    # The last setpoint is sent when the drone has been blind for too long; half a second later the autopilot takes it.
    assert not obeyed_after(result, 1.5 + limits.state_age + limits.blind_time + 0.5)


def test_restarted_in_the_air_it_stays_silent(world):
    result = fly(world, Fault("restart-node", 1.5))
    assert result.reason == "held", (result, result.log)
    assert not obeyed_after(result, 1.6)
    began = next(c.time for c in result.commands if c.mode is Mode.OFFBOARD)
    # For ten seconds, in which it starts again, nothing comes from it.
    assert result.flight_time_s > 11.0
    assert max(c.time for c in result.commands) < began + 1.6


def test_paused_it_does_not_go_on_with_what_it_was_doing(world):
    result = fly(world, Fault("pause-node", 1.5, 0.4))
    silent = [b - a for a, b in zip(obeyed_after(result, 1.0), obeyed_after(result, 1.0)[1:], strict=False)]
    assert max(silent) > 0.35
    # Half a second is the autopilot's patience: it either kept the vehicle with the node or took it.
    assert result.reason in ("arrived", "held"), (result, result.log)
