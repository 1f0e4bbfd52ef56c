"""The node itself on the rig, in real time, under faults.

The speed of a flight depends on the machine. Its end, and what the node must never do, do not.
"""

from collections.abc import Container
from typing import Any

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.failsafe_process import takeover_time
from aero_planner.onboard.livox import CARTESIAN_CM
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.rig import Fault, RigResult, fly_rig
from aero_viz.rig.offboard import Mode
from aero_viz.scenes import World
from aero_viz.sensors.models import LidarModel

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
    # These hold in every flight.
    assert result.violations == []
    assert result.refused == 0 or any(fault.kind == "corrupt" for fault in faults)
    assert result.reason != "collision", (result, result.log)
    return result


def obeyed_after(result: RigResult, time: float) -> list[float]:
    """Return the times of obeyed setpoints later than `time`, all counted from the engagement [s]."""
    return setpoints_after(result, time, modes=(Mode.OFFBOARD,))


def setpoints_after(result: RigResult, time: float, modes: Container[Mode] = Mode) -> list[float]:
    """Return the times of setpoints later than `time` in any of the modes, counted from the engagement [s]."""
    began = next(c.time for c in result.commands if c.mode is Mode.OFFBOARD)
    return [c.time - began for c in result.commands if c.mode in modes and c.time - began > time]


def test_the_node_flies_between_posts_to_the_goal(world):
    result = fly(world)
    assert result.arrived, (result, result.log)
    assert result.max_speed < 4.5


def test_centimetre_packets_paired_messages_and_a_mounted_sensor_work_as_well(world):
    lidar = LidarModel("mid360", mount_angles=(0.0, 20.0, 0.0), mount_position=(0.1, 0.0, 0.05))
    result = fly(world, data_type=CARTESIAN_CM, state_pair=True, lidar=lidar)
    assert result.arrived, (result, result.log)


def test_without_points_the_node_brakes_and_hands_back(world):
    result = fly(world, Fault("kill-sensor", 1.5))
    assert result.reason == "held", (result, result.log)
    # Points may be half a second old; after that the node brakes from 3 m/s.
    assert result.trajectory.speeds()[result.trajectory.times > 5.0].max() < 0.5


def test_without_states_the_node_brakes_by_dead_reckoning_and_hands_back(world):
    result = fly(world, Fault("freeze-state", 1.5, 20.0))
    assert result.reason == "held", (result, result.log)
    limits = ONBOARD.limits
    # The node stops sending when it has been blind for too long, and the autopilot takes over half a second later.
    assert not obeyed_after(result, 1.5 + limits.state_age + limits.blind_time + 0.5)


def test_a_drone_that_loses_its_gnss_fix_brakes_within_a_second_and_is_handed_back(world):
    result = fly(world, Fault("lose-position", 1.5), onboard=ONBOARD.replace({"limits.brake_time": 3.0}))
    assert result.reason == "held", (result, result.log)
    assert any("BRAKING: the autopilot's GNSS receiver has lost its fix" in line for line in result.log), result.log
    # It is at rest before its estimator would have reported the loss.
    assert speed_at(result, 1.4) > 1.5 and speed_at(result, 3.5) < 0.4


def test_without_gnss_a_lost_position_is_noticed_by_its_uncertainty(world):
    lost = Fault("lose-position", 1.0)
    limits = {"limits.fix_age": 1e4, "limits.velocity_std": 0.1, "limits.brake_time": 3.0}
    result = fly(world, lost, onboard=ONBOARD.replace(limits))
    assert result.reason == "held", (result, result.log)
    assert any("position or velocity is too uncertain" in line for line in result.log)


def longest_gap(result: RigResult, begin: float, end: float) -> float:
    """Return the longest time between two obeyed setpoints from `begin` to `end` after the engagement [s]."""
    times = [time for time in obeyed_after(result, begin) if time <= end]
    return float(np.diff([begin, *times, end]).max())


def speed_at(result: RigResult, time: float) -> float:
    return float(result.trajectory.speeds()[np.searchsorted(result.trajectory.times, time)])


def test_the_failsafe_brakes_for_a_killed_node_and_the_restarted_node_stays_silent(world):
    killed, blind_time = 1.5, ONBOARD.limits.blind_time
    result = fly(world, Fault("restart-node", killed))
    assert result.reason == "held", (result, result.log)
    # The failsafe process takes over at once and continues until the drone hovers.
    assert longest_gap(result, killed, killed + blind_time) < ONBOARD.limits.deadline, result.log
    before, after = speed_at(result, killed), speed_at(result, killed + blind_time)
    assert before > 1.5 and after < 0.4
    obeyed = [c for c in result.commands if c.mode is Mode.OFFBOARD]
    assert obeyed[-1].rates == (0.0, 0.0, 0.0)
    assert obeyed[-1].thrust == pytest.approx(CONFIG.vehicle.mass * CONFIG.vehicle.gravity, rel=1e-3)
    # Nothing else is sent for ten seconds, in which the node starts again.
    assert result.flight_time_s > 11.0
    assert not [time for time in setpoints_after(result, killed) if time > killed + blind_time + 0.2]
    assert any("already armed when the node started" in line for line in result.log)


def test_the_failsafe_brakes_for_a_paused_node_which_then_continues(world):
    # 0.14 s pass until the pause is noticed, and 0.2 s until the drone has turned; then it brakes with 6 m/s^2.
    paused, duration = 1.5, 0.8
    result = fly(world, Fault("pause-node", paused, duration))
    # The autopilot sees an uninterrupted stream: first the plan, then the braking commands.
    assert longest_gap(result, paused, paused + duration + 1.0) < ONBOARD.limits.deadline, result.log
    assert speed_at(result, paused + duration) < 0.6 * speed_at(result, paused)
    # A busy machine may stall the node at other times as well.
    assert any("the failsafe process brakes" in line for line in result.log)
    assert any("FLYING -> BRAKING: the control loop stalled" in line for line in result.log)
    assert result.arrived and result.trajectory.offboard.all(), (result, result.log)


def test_a_node_paused_for_too_long_stays_silent(world):
    paused, limits = 1.5, ONBOARD.limits
    end = paused + takeover_time(ONBOARD) + limits.blind_time
    result = fly(world, Fault("pause-node", paused, 4.0))
    assert result.reason == "held", (result, result.log)
    assert longest_gap(result, paused, end) < ONBOARD.limits.deadline, result.log
    assert speed_at(result, end) < 0.4
    assert not [time for time in setpoints_after(result, end + 0.2)]
    assert any("HANDED_BACK: the control loop stalled for too long" in line for line in result.log)
