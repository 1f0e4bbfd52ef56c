"""The simulated autopilot: PX4's rules for offboard control, its messages, and its vehicle."""

import math
import struct

import numpy as np
import pytest
import warp as wp

from aero_planner.onboard.thrust import ThrustModel
from aero_viz.flight.vehicle import Vehicle
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.autopilot import PERIOD
from aero_viz.rig.offboard import Mode
from tests.rig.companion import HALF, START, mavlink


def test_offboard_needs_arming_and_a_stream(make_companion):
    c = make_companion()
    c.autopilot.arm()
    assert not c.autopilot.engage()  # nothing has come
    c.run(0.9)
    assert not c.autopilot.engage()  # not for long enough
    c.run(0.2)
    assert c.autopilot.engage()
    assert c.autopilot.mode is Mode.OFFBOARD
    unarmed = make_companion()
    unarmed.run(1.1)
    assert not unarmed.autopilot.engage()  # not armed


def test_fewer_than_two_setpoints_per_second_are_not_a_stream(make_companion):
    c = make_companion()
    c.autopilot.arm()
    c.run(5.0, every=0.6)
    assert not c.autopilot.engage()
    slow = make_companion()
    slow.autopilot.arm()
    slow.run(5.0, every=0.4)
    assert slow.autopilot.engage()


def test_offboard_ends_half_a_second_after_the_last_setpoint(make_companion):
    c = make_companion()
    c.fly(1.0, rates=(0.0, -0.3, 0.0), thrust=0.52)
    assert np.linalg.norm(c.autopilot.velocity) > 0.5
    c.run(0.48, every=None)
    assert c.autopilot.mode is Mode.OFFBOARD
    c.run(0.04, every=None)
    assert c.autopilot.mode is Mode.HOLD
    # The failsafe brakes the vehicle and holds its position.
    c.run(8.0, every=None)
    assert np.linalg.norm(c.autopilot.velocity) < 0.02
    place = c.autopilot.position
    c.run(2.0, every=None)
    np.testing.assert_allclose(c.autopilot.position, place, atol=0.05)
    # A stream that resumes does not get control: only the pilot can give it.
    c.run(2.0)
    assert c.autopilot.mode is Mode.HOLD


def test_a_late_simulation_does_not_obey_a_command_before_it_was_sent(make_companion):
    c = make_companion()
    c.run(0.1, every=None)
    c.autopilot.start(late_by=5.0)  # as if five seconds had passed, of which the simulation has flown none
    c.command()
    c.run(4.5, every=None)
    assert c.autopilot.setpoints == []
    c.run(60.0, every=None)
    (setpoint,) = c.autopilot.setpoints
    assert setpoint.time > 5.0


def test_a_late_simulation_in_lockstep_obeys_a_command_at_once(make_companion):
    c = make_companion(lockstep=True)
    c.run(0.1, every=None)
    c.autopilot.start(late_by=5.0)
    c.command()
    c.run(0.1, every=None)
    (setpoint,) = c.autopilot.setpoints
    assert 0.1 < setpoint.time < 0.2


def test_commands_have_no_effect_before_offboard(make_companion):
    c = make_companion()
    c.run(2.0, thrust=0.9, rates=(1.0, 1.0, 1.0))
    np.testing.assert_allclose(c.autopilot.position, START)
    c.autopilot.arm()
    c.run(2.0, thrust=0.9, rates=(1.0, 1.0, 1.0))
    np.testing.assert_allclose(c.autopilot.position, START, atol=1e-3)
    assert {setpoint.mode for setpoint in c.autopilot.setpoints} == {Mode.HOLD}


def test_commands_have_the_expected_effects(make_companion):
    # Nose down (FRD pitch -0.5 rad/s) for 0.4 s: it goes north; a roll to the right: it goes east, -y.
    north = make_companion()
    north.fly(0.4, rates=(0.0, -0.5, 0.0))
    assert north.autopilot.velocity[0] > 0.3
    east = make_companion()
    east.fly(0.4, rates=(0.5, 0.0, 0.0))
    assert east.autopilot.velocity[1] < -0.3
    up = make_companion()
    up.fly(0.4, thrust=0.6)
    # 0.6 / 0.5 of the weight: 0.2 g.
    assert up.autopilot.velocity[2] == pytest.approx(0.2 * 9.81 * 0.4, rel=0.02)
    square = make_companion(curve=1.0)
    square.fly(0.4, thrust=0.6)
    assert square.autopilot.velocity[2] == pytest.approx(0.44 * 9.81 * 0.4, rel=0.02)


@pytest.mark.parametrize(("compensation", "curve"), [(0.6, 0.0), (0.0, 0.6)])
def test_the_node_must_not_compensate_a_curve_that_the_autopilot_compensates(make_companion, compensation, curve):
    c = make_companion(hover_thrust=0.4, curve=0.6, compensation=compensation)
    for weights in (0.5, 1.0, 1.7):
        force = weights * 9.81
        c.run(0.04, thrust=ThrustModel(mass=1.0, hover_thrust=0.4, curve=curve).signal(force))
        assert c.autopilot.setpoints[-1].thrust == pytest.approx(force, rel=1e-6)


def test_a_curve_compensated_twice_gives_the_wrong_thrust(make_companion):
    c = make_companion(hover_thrust=0.4, curve=0.6, compensation=0.6)
    c.run(0.04, thrust=ThrustModel(mass=1.0, hover_thrust=0.4, curve=0.6).signal(1.7 * 9.81))
    assert c.autopilot.setpoints[-1].thrust < 1.6 * 9.81


def test_the_vehicle_behaves_as_in_a_simulated_flight(make_companion):
    c = make_companion(heading=0.7)
    c.fly()
    twin = Vehicle(VehicleModel(step=PERIOD), np.array([START]), [0.7], period=PERIOD, device="cpu")
    # The same initial state and the same commands.
    for name in ("position", "velocity", "quaternion"):
        getattr(twin, name).assign(getattr(c.autopilot.vehicle, name))
    thrusts, rates = (0.5, 0.55, 0.47), ((0.4, -0.6, 0.2), (-0.3, 0.2, 0.5), (0.0, 0.7, -1.0))
    for thrust, rate in zip(thrusts, rates, strict=True):
        c.run(0.2, thrust=thrust, rates=rate)
    for thrust, rate in zip(thrusts, rates, strict=True):
        control = (float(np.float32(thrust)) / 0.5 * 9.81, rate[0], -rate[1], -rate[2])
        for _ in range(50):
            twin.fly(wp.array([[control]], dtype=wp.vec4), active=wp.ones(1, dtype=int))
    np.testing.assert_allclose(c.autopilot.position, twin.position.numpy()[0], atol=1e-4)
    np.testing.assert_allclose(c.autopilot.velocity, twin.velocity.numpy()[0], atol=1e-4)


@pytest.mark.parametrize(
    "command",
    [
        {"thrust": math.nan},
        {"rates": (math.inf, 0.0, 0.0)},
        {"mask": 0, "attitude": (math.nan, 0.0, 0.0, 0.0)},
        {"mask": 128 | 7},  # neither attitude nor rates
        {"mask": 128 | 1},
        {"mask": 128 | 64},
        {"component": 7},
    ],
)
def test_invalid_setpoints_are_refused_and_do_not_count_as_a_stream(make_companion, command):
    c = make_companion()
    c.autopilot.arm()
    c.run(2.0, **command)
    assert c.autopilot.refused == 100
    assert c.autopilot.setpoints == []
    assert not c.autopilot.engage()


def test_the_companion_may_not_arm_or_change_the_mode(make_companion):
    c = make_companion()
    arm = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
    c.send(mavlink.MAVLink_command_long_message(1, 1, arm, 0, 1.0, *[0.0] * 6))
    c.send(mavlink.MAVLink_set_mode_message(1, 1, 6 << 16))
    c.run(0.1)
    assert not c.autopilot.armed
    assert c.autopilot.mode is Mode.HOLD
    assert c.autopilot.violations == [f"COMMAND_LONG {arm}", "SET_MODE"]


def test_a_heartbeat_is_sent_once_per_second(make_companion):
    c = make_companion()
    c.fly()
    c.run(2.5)
    heartbeats = c.got("HEARTBEAT")
    assert [round(time) for time, _ in heartbeats] == list(range(len(heartbeats)))
    _, first = heartbeats[0]
    _, last = heartbeats[-1]
    assert (first.base_mode & 128, first.custom_mode) == (0, 4 << 16 | 3 << 24)
    assert (last.base_mode & 128, last.custom_mode) == (128, 6 << 16)


def test_odometry_is_in_the_ned_frame(make_companion):
    c = make_companion(heading=-0.5 * math.pi)  # nose to -y, the east
    c.run(0.1)
    _, message = c.got("ODOMETRY")[0]
    np.testing.assert_allclose([message.x, message.y, message.z], [1.0, -2.0, -3.0])
    np.testing.assert_allclose(message.q, [HALF, 0.0, 0.0, HALF], atol=1e-6)
    assert (message.frame_id, message.child_frame_id) == (1, 1)
    c.fly(0.5, thrust=0.6)
    _, message = c.got("ODOMETRY")[-1]
    assert message.vz == pytest.approx(-c.autopilot.velocity[2], abs=0.05)


def test_the_companion_sets_the_rate_of_states(make_companion):
    c = make_companion()
    c.run(1.0)
    assert len(c.got("ODOMETRY")) == pytest.approx(50, abs=2)
    c.send(mavlink.MAVLink_command_long_message(1, 1, 511, 0, 331, 10_000, *[0.0] * 5))
    c.run(1.0)
    ((_, answer),) = c.got("COMMAND_ACK")
    assert (answer.command, answer.result) == (511, mavlink.MAV_RESULT_ACCEPTED)
    # 100 Hz in steps of 4 ms.
    assert len(c.got("ODOMETRY")) == pytest.approx(140, abs=12)
    stamps = np.array([message.time_usec for _, message in c.got("ODOMETRY")])
    assert (np.diff(stamps) > 0).all()


def request(c, number, rate):
    c.send(mavlink.MAVLink_command_long_message(1, 1, 511, 0, number, 1e6 / rate, *[0.0] * 5))


def test_the_landed_state_is_reported_on_request(make_companion):
    c = make_companion(takeoff_time=0.5, ground=2.9)
    c.run(1.0)
    assert c.got("EXTENDED_SYS_STATE") == []
    request(c, 245, 10)
    c.run(1.0)
    c.autopilot.arm()
    c.run(1.0)
    states = [message.landed_state for _, message in c.got("EXTENDED_SYS_STATE")]
    assert len(states) == pytest.approx(20, abs=2)
    on_ground, taking_off, in_air = states[:10], states[10:15], states[15:]
    assert set(on_ground) == {mavlink.MAV_LANDED_STATE_ON_GROUND}
    assert set(taking_off) <= {mavlink.MAV_LANDED_STATE_TAKEOFF, mavlink.MAV_LANDED_STATE_ON_GROUND}
    assert set(in_air[1:]) == {mavlink.MAV_LANDED_STATE_IN_AIR}


def test_the_vehicle_takes_off_from_the_ground_to_its_start(make_companion):
    c = make_companion(ground=0.1)
    request(c, 245, 10)
    c.run(1.0)
    np.testing.assert_allclose(c.autopilot.position, [1.0, 2.0, 0.1])
    c.autopilot.arm()
    c.run(1.0)
    assert c.got("EXTENDED_SYS_STATE")[-1][1].landed_state == mavlink.MAV_LANDED_STATE_TAKEOFF
    c.run(4.0)
    np.testing.assert_allclose(c.autopilot.position, START, atol=0.1)
    assert c.got("EXTENDED_SYS_STATE")[-1][1].landed_state == mavlink.MAV_LANDED_STATE_IN_AIR


def test_the_pilot_arms_when_the_companion_must_have_seen_a_heartbeat(make_companion):
    c = make_companion()
    c.run(3.0, every=None)
    assert not c.autopilot.ready_to_arm
    c.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    c.run(1.4, every=None)
    assert not c.autopilot.ready_to_arm
    c.run(0.2, every=None)
    assert c.autopilot.ready_to_arm


def test_a_lost_position_drifts_and_grows_uncertain(make_companion):
    c = make_companion(height_offset=0.48)
    c.run(0.5)
    _, known = c.got("ODOMETRY")[-1]
    assert c.got("GPS_RAW_INT")[-1][1].fix_type == mavlink.GPS_FIX_TYPE_3D_FIX
    assert known.z == pytest.approx(-3.48) and known.pose_covariance[0] == pytest.approx(0.04)
    c.autopilot.lose_position()
    c.run(13.0)
    _, lost = c.got("ODOMETRY")[-1]
    assert c.got("GPS_RAW_INT")[-1][1].fix_type == mavlink.GPS_FIX_TYPE_NO_GPS
    assert np.hypot(lost.x - known.x, lost.y - known.y) == pytest.approx(6.0, abs=0.1)
    assert lost.pose_covariance[6] == pytest.approx(31.0, rel=0.05)
    assert lost.velocity_covariance[11] ** 0.5 == pytest.approx(0.9, abs=0.01)
    c.autopilot.lose_position(False)
    c.run(0.2)
    _, found = c.got("ODOMETRY")[-1]
    assert c.got("GPS_RAW_INT")[-1][1].fix_type == mavlink.GPS_FIX_TYPE_3D_FIX
    assert found.x == pytest.approx(known.x) and found.velocity_covariance[0] ** 0.5 == pytest.approx(0.05)


def test_a_pair_of_messages_can_replace_odometry(make_companion):
    c = make_companion(pair=True)
    c.run(0.5)
    assert c.got("ODOMETRY") == []
    assert len(c.got("LOCAL_POSITION_NED")) == len(c.got("ATTITUDE_QUATERNION")) > 20


def test_a_frozen_state_repeats_the_same_message(make_companion):
    c = make_companion()
    c.fly(0.5, thrust=0.6)
    c.autopilot.frozen = True
    before = len(c.got("ODOMETRY"))
    c.run(0.5, thrust=0.6)
    frozen = [(message.time_usec, message.z) for _, message in c.got("ODOMETRY")[before:]]
    assert len(frozen) > 20
    assert len(set(frozen)) == 1
    c.autopilot.frozen = False
    c.run(0.1)
    assert c.got("ODOMETRY")[-1][1].z < frozen[0][1]


def test_parameters_are_sent_in_px4s_encoding(make_companion):
    c = make_companion(loss_time=0.5)
    for name in (b"COM_OF_LOSS_T", b"NAV_RCL_ACT", b"ABSENT"):
        c.send(mavlink.MAVLink_param_request_read_message(1, 1, name, -1))
    c.run(0.1, every=None)
    number, action = (message for _, message in c.got("PARAM_VALUE"))
    assert (number.param_id, number.param_value) == ("COM_OF_LOSS_T", 0.5)
    assert action.param_type == mavlink.MAV_PARAM_TYPE_INT32
    assert struct.unpack("<i", struct.pack("<f", action.param_value)) == (1,)
