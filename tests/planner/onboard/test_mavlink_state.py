"""Vehicle states from the messages of an autopilot, over real sockets."""

import math

import numpy as np
import pytest

from tests.planner.onboard.mavlink_peer import (
    ARMED,
    HALF,
    HOLD,
    NAN21,
    OFFBOARD,
    attitude,
    battery,
    distance,
    gnss,
    landed_state,
    local_position,
    mavlink,
    odometry,
    state_after,
    transmitter,
)


def test_odometry_with_world_velocity_by_hand(link, autopilot):
    # 10 m north, 4 m east, 3 m up; nose to the east; 2 m/s north, 1 m/s east, climbing 0.5 m/s.
    state = state_after(link, autopilot, odometry((10, 4, -3), (HALF, 0, 0, HALF), (2, 1, -0.5)))
    np.testing.assert_allclose(state.position, [10, -4, 3])
    np.testing.assert_allclose(state.velocity, [2, -1, 0.5])
    np.testing.assert_allclose(state.quaternion, [HALF, 0, 0, -HALF], atol=1e-7)


@pytest.mark.parametrize("child", [mavlink.MAV_FRAME_BODY_FRD, mavlink.MAV_FRAME_BODY_NED])
def test_odometry_with_body_velocity_by_hand(link, autopilot, child):
    # Nose to the east, 3 m/s forward and 1 m/s to the right (south): -y and -x of the world.
    state = state_after(link, autopilot, odometry(q=(HALF, 0, 0, HALF), v=(3, 1, 0), child=child))
    np.testing.assert_allclose(state.velocity, [-1, -3, 0], atol=1e-6)


def test_position_and_attitude_messages_make_a_state(link, autopilot, clock):
    state = state_after(
        link, autopilot, attitude((1, 0, 0, 0), (0, 0, 0), 5.0), local_position((1, 2, -3), (4, 5, -6), 5.0)
    )
    np.testing.assert_allclose(state.position, [1, -2, 3])
    np.testing.assert_allclose(state.velocity, [4, -5, 6])
    # The attitude is propagated to the time of the position: nose up (FRD) at 2 rad/s for 20 ms.
    clock.now += 0.03
    turning = attitude((1, 0, 0, 0), (0, 2, 0), 5.01)
    state = state_after(link, autopilot, turning, local_position((1, 2, -3), (4, 5, -6), 5.03))
    np.testing.assert_allclose(state.quaternion, [math.cos(0.02), 0, -math.sin(0.02), 0], atol=1e-6)


def test_an_old_attitude_is_not_used(link, autopilot):
    stale = attitude((1, 0, 0, 0), (0, 0, 0), 5.0)
    assert state_after(link, autopilot, stale, local_position((1, 2, 3), (0, 0, 0), 5.2)) is None


def test_odometry_takes_precedence_over_the_pair(link, autopilot, clock):
    pair = attitude((1, 0, 0, 0), (0, 0, 0), 5.02), local_position((9, 9, 9), (0, 0, 0), 5.02)
    state_after(link, autopilot, odometry((1, 0, 0)))
    clock.now += 0.5
    np.testing.assert_allclose(state_after(link, autopilot, *pair).position, [1, 0, 0])
    clock.now += 2.0
    later = attitude((1, 0, 0, 0), (0, 0, 0), 7.5), local_position((9, 9, 9), (0, 0, 0), 7.5)
    np.testing.assert_allclose(state_after(link, autopilot, *later).position, [9, -9, -9])


@pytest.mark.parametrize("unusable", [dict(frame=mavlink.MAV_FRAME_GLOBAL), dict(p=(math.nan, 0, 0))])
def test_unusable_odometry_does_not_take_precedence(link, autopilot, clock, unusable):
    for k in range(3):
        clock.now += 0.02
        time = 5.0 + 0.02 * k
        pair = attitude((1, 0, 0, 0), (0, 0, 0), time), local_position((1, 2, 3), (0, 0, 0), time)
        assert state_after(link, autopilot, odometry(time=time, **unusable), *pair) is not None
    assert sum(link.dropped.values()) == 3
    # It continues to be requested, too.
    autopilot.heartbeat()
    link.poll()
    autopilot.received("COMMAND_LONG")
    clock.now += 2.0
    for k in range(200):
        autopilot.send(odometry(time=7.0 + 0.01 * k, **unusable))
        link.poll()
    autopilot.heartbeat()
    link.poll()
    requested = [request.param1 for request in autopilot.received("COMMAND_LONG")]
    assert mavlink.MAVLINK_MSG_ID_ODOMETRY in requested


def test_resets_are_counted_with_the_state(link, autopilot, clock):
    seen = []
    for k, counter in enumerate([7, 7, 8, 8, 8, 0]):
        clock.now += 0.02
        state_after(link, autopilot, odometry((k, 0, 0), time=5.0 + 0.02 * k, resets=counter))
        autopilot.heartbeat()
        link.poll()
        seen.append(link.state.resets)
    assert seen == [0, 0, 1, 1, 1, 2]
    # States that are not accepted, because they are old or unusable, count no reset.
    state_after(link, autopilot, odometry(time=5.0, resets=9), odometry((math.nan, 0, 0), time=6.0, resets=9))
    autopilot.heartbeat()
    link.poll()
    assert link.state.resets == 2


def test_a_jump_without_reset_counter_is_a_reset(link, autopilot, clock):
    seen = []
    # 5 m/s north, 30 times per second; then 1.5 m to the side, a turn by 20 degrees, and ODOMETRY again.
    places = [(0, 0), (0.17, 0), (0.33, 0), (0.5, 1.5), (0.67, 1.5), (0.83, 1.5)]
    for k, (x, y) in enumerate(places):
        clock.now += 0.0333
        time = 5.0 + 0.0333 * k
        half = math.radians(10.0 if k >= 4 else 0.0)
        q = (math.cos(half), 0, 0, math.sin(half))
        state_after(link, autopilot, attitude(q, (0, 0, 0), time), local_position((x, y, 0), (5, 0, 0), time))
        seen.append(link.state.resets)
    clock.now += 0.02
    state_after(link, autopilot, odometry(time=5.3))
    assert [*seen, link.state.resets] == [0, 0, 0, 1, 2, 2, 3]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("x", "vx"), [(math.nan, 0.0), (math.inf, math.inf)])
def test_a_position_that_is_not_finite_is_dropped_and_is_no_reset(link, autopilot, clock, x, vx):
    level, still = (1, 0, 0, 0), (0, 0, 0)
    for k, (north, speed) in enumerate([(0.0, 0.0), (x, vx), (0.0, 0.0)]):
        clock.now += 0.02
        time = 5.0 + 0.02 * k
        place = local_position((north, 0, 0), (speed, 0, 0), time)
        state_after(link, autopilot, attitude(level, still, time), place)
    assert link.dropped == {"LOCAL_POSITION_NED that is not finite or beyond 1e+06": 1}
    assert link.state.resets == 0


def test_states_carry_host_time_and_never_go_back(link, autopilot, clock):
    for k, delay in enumerate([0.004, 0.001, 0.009]):
        clock.now = 100.0 + 0.02 * k + delay
        state_after(link, autopilot, odometry((k, 0, 0), time=5.0 + 0.02 * k))
    assert link.state.time == pytest.approx(100.041)
    assert link.state.state.time == link.state.time
    before = link.state
    state_after(link, autopilot, odometry((7, 0, 0), time=5.01))
    assert link.state is before
    # A repeated state does not become newer.
    clock.now += 1.0
    state_after(link, autopilot, odometry((8, 0, 0), time=5.04))
    assert link.state is before


@pytest.mark.parametrize(
    "message",
    [
        odometry((math.nan, 0, 0)),
        odometry((0, math.inf, 0)),
        odometry((0, 0, 2e6)),
        odometry(v=(0, math.nan, 0)),
        odometry(v=(math.nan, 0, 0), child=mavlink.MAV_FRAME_BODY_FRD),
        odometry(q=(math.nan, 0, 0, 0)),
        odometry(q=(0, 0, 0, 0)),
        odometry(frame=mavlink.MAV_FRAME_GLOBAL),
        odometry(child=mavlink.MAV_FRAME_GLOBAL),
    ],
)
def test_unusable_states_are_dropped_and_counted(link, autopilot, message):
    assert state_after(link, autopilot, message) is None
    (reason,) = link.dropped.items()
    assert reason in ((f"ODOMETRY in frames {message.frame_id} and {message.child_frame_id}", 1),
                      ("ODOMETRY that is not finite or beyond 1e+06", 1))  # fmt: skip
    state_after(link, autopilot, odometry(time=5.1))
    assert link.state is not None


@pytest.mark.parametrize(
    ("base", "mode", "armed", "offboard"),
    [
        (ARMED, OFFBOARD, True, True),
        (ARMED, HOLD, True, False),
        (ARMED ^ mavlink.MAV_MODE_FLAG_SAFETY_ARMED, OFFBOARD, False, True),
        (mavlink.MAV_MODE_FLAG_SAFETY_ARMED, OFFBOARD, True, False),
    ],
)
def test_heartbeats_report_arming_and_mode(link, autopilot, clock, base, mode, armed, offboard):
    state_after(link, autopilot, odometry())
    assert link.state.heartbeat_time == -math.inf
    clock.now += 0.5
    autopilot.heartbeat(base, mode)
    link.poll()
    assert (link.state.armed, link.state.offboard) == (armed, offboard)
    assert link.state.heartbeat_time == clock.now


@pytest.mark.parametrize(("landed", "in_air"), [(0, None), (1, False), (2, True), (3, False), (4, False)])
def test_the_landed_state_is_reported_while_it_is_fresh(link, autopilot, clock, landed, in_air):
    assert state_after(link, autopilot, odometry()) is not None and link.state.in_air is None
    state_after(link, autopilot, landed_state(landed))
    assert link.state.in_air is in_air
    clock.now += 3.1
    state_after(link, autopilot, odometry(time=8.1))
    assert link.state.in_air is None


def diagonal(x, y, z):
    """Return the upper triangle of a covariance of which, as in PX4, only the diagonal is known."""
    values = list(NAN21)
    values[0], values[6], values[11] = x, y, z
    return values


@pytest.mark.parametrize(
    ("pose", "velocity", "stds"),
    [
        (diagonal(0.04, 0.09, 0.01), diagonal(0.01, 0.01, 0.0625), (0.3, 0.25)),
        (diagonal(4.0, math.nan, 0.0), diagonal(math.inf, 0.01, 0.01), (2.0, math.inf)),
        (NAN21, [0.0] * 21, (math.nan, math.nan)),
        (diagonal(-1.0, -1.0, -1.0), NAN21, (math.nan, math.nan)),
    ],
)
def test_the_uncertainty_comes_from_the_covariances(link, autopilot, pose, velocity, stds):
    state_after(link, autopilot, odometry(variances=(pose, velocity)))
    np.testing.assert_allclose([link.state.position_std, link.state.velocity_std], stds, rtol=1e-6)


def test_the_pair_of_messages_has_no_uncertainty(link, autopilot, clock):
    state_after(link, autopilot, odometry(variances=(diagonal(1.0, 1.0, 1.0),) * 2))
    clock.now += 2.0
    pair = attitude((1, 0, 0, 0), (0, 0, 0), 7.0), local_position((0, 0, 0), (0, 0, 0), 7.0)
    state_after(link, autopilot, *pair)
    assert math.isnan(link.state.position_std) and math.isnan(link.state.velocity_std)


def test_the_time_of_the_newest_gnss_fix(link, autopilot, clock):
    state_after(link, autopilot, gnss(mavlink.GPS_FIX_TYPE_2D_FIX), odometry())
    assert math.isnan(link.state.fix_time)
    for kind in (mavlink.GPS_FIX_TYPE_3D_FIX, mavlink.GPS_FIX_TYPE_RTK_FIXED):
        clock.now += 1.0
        state_after(link, autopilot, gnss(kind))
        assert link.state.fix_time == clock.now
    fixed = clock.now
    clock.now += 1.0
    state_after(link, autopilot, gnss(mavlink.GPS_FIX_TYPE_NO_FIX), odometry(time=6.0))
    assert link.state.fix_time == fixed


def test_a_transmitter_is_lost_when_it_is_no_longer_present_or_reported(link, autopilot, clock):
    state_after(link, autopilot, odometry(), transmitter(False))
    assert link.state.transmitter is None  # there never was one
    for reports, heard in (([transmitter(True)], True), ([transmitter(False)], False), ([transmitter(True)], True)):
        state_after(link, autopilot, *reports)
        assert link.state.transmitter is heard
    clock.now += 3.1
    state_after(link, autopilot, odometry(time=8.2))
    assert link.state.transmitter is False


def test_a_warning_of_any_battery_stays_in_flight(link, autopilot):
    ok, low, failed = (getattr(mavlink, f"MAV_BATTERY_CHARGE_STATE_{name}") for name in ("OK", "LOW", "FAILED"))
    autopilot.heartbeat(ARMED)
    state_after(link, autopilot, odometry(), battery(ok), battery(ok, 1))
    assert not link.state.battery_low
    state_after(link, autopilot, battery(low, 1), battery(ok), battery(ok, 1))
    assert link.state.battery_low
    autopilot.heartbeat(0)
    state_after(link, autopilot, battery(ok, 1))
    assert not link.state.battery_low
    state_after(link, autopilot, battery(failed))
    assert link.state.battery_low


def test_the_height_of_the_ground_comes_from_a_sensor_that_looks_down(link, autopilot, clock):
    state_after(link, autopilot, distance(150))
    tilted = math.radians(10.0)
    state_after(link, autopilot, odometry((0, 0, -2), (math.cos(tilted), math.sin(tilted), 0, 0)))
    assert math.isnan(link.state.ground_height)
    state_after(link, autopilot, distance(150))
    assert link.state.ground_height == pytest.approx(2.0 - 1.5 * math.cos(2 * tilted))
    for unusable in (distance(300, orientation=0), distance(1000), distance(20), distance(300, quality=1)):
        state_after(link, autopilot, unusable)
    state_after(link, autopilot, odometry((0, 0, -2.2), time=5.1))
    assert link.state.ground_height == pytest.approx(2.0 - 1.5 * math.cos(2 * tilted))
    clock.now += 1.1
    state_after(link, autopilot, odometry((0, 0, -2), time=6.1))
    assert math.isnan(link.state.ground_height)


def test_a_distance_is_not_used_when_the_vehicle_is_tilted(link, autopilot):
    half = math.radians(20.0)
    state_after(link, autopilot, odometry((0, 0, -2), (math.cos(half), math.sin(half), 0, 0)), distance(150))
    assert math.isnan(link.state.ground_height)
