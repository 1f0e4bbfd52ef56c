"""The MAVLink connection over real sockets, with an autopilot that sends pymavlink's own messages."""

import math
import os
import socket
from typing import Any

import numpy as np
import pytest

from aero_planner.onboard import mavlink as mavlink_module
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.thrust import ThrustModel

mavlink = load_dialect()
HALF = math.sqrt(0.5)
NAN21 = [math.nan] * 21
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24


class Peer:
    """The other end of a link."""

    def __init__(self, url_port, system=1, component=1):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.address = ("127.0.0.1", url_port)
        self.protocol = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.parser = mavlink.MAVLink(None)

    def send(self, *messages):
        self.socket.sendto(b"".join(bytes(m.pack(self.protocol)) for m in messages), self.address)

    def heartbeat(self, base=ARMED, mode=OFFBOARD):
        self.send(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, base, mode, 4, 3))

    def received(self, name):
        messages = []
        while True:
            try:
                messages += self.parser.parse_buffer(self.socket.recv(2048)) or []
            except BlockingIOError:
                return [m for m in messages if m.get_type() == name]


def odometry(
    p=(0, 0, 0), q=(1, 0, 0, 0), v=(0, 0, 0), *, time=5.0, frame=1, child=1, resets=0, variances=(NAN21, NAN21)
):
    values = [*map(float, p), list(map(float, q)), *map(float, v), 0.0, 0.0, 0.0]
    return mavlink.MAVLink_odometry_message(int(1e6 * time), frame, child, *values, *variances, resets, 0)


def landed_state(state):
    return mavlink.MAVLink_extended_sys_state_message(0, state)


def local_position(p, v, time):
    return mavlink.MAVLink_local_position_ned_message(int(1e3 * time), *map(float, p), *map(float, v))


def attitude(q, rates, time):
    return mavlink.MAVLink_attitude_quaternion_message(int(1e3 * time), *map(float, q), *map(float, rates))


def goal_message(p, *, system=1, component=191, mask=0b110111111000, frame=1):
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, component, frame, mask, *map(float, p), *[0.0] * 8
    )


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def link(clock, port):
    senders = [(1, None), (255, None), (255, "127.0.0.1")]
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", ThrustModel(2.0, hover_thrust=0.4), goal_senders=senders, clock=clock)
    yield link
    link.close()


@pytest.fixture
def autopilot(link, port):
    peer = Peer(port)
    yield peer
    peer.socket.close()


def state_after(link, autopilot, *messages) -> Any:
    autopilot.send(*messages)
    link.poll()
    return None if link.state is None else link.state.state


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


def gnss(fix_type):
    return mavlink.MAVLink_gps_raw_int_message(0, fix_type, 0, 0, 0, 0, 0, 0, 0, 0)


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


def distance(centimetres, *, orientation=25, quality=0):
    return mavlink.MAVLink_distance_sensor_message(
        0, 20, 1000, centimetres, 0, 0, orientation, 0, 0.0, 0.0, [0.0] * 4, quality
    )


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


def test_heartbeats_from_other_components_are_ignored(link, autopilot):
    state_after(link, autopilot, odometry())
    for system, component in [(255, 190), (1, 154), (2, 1)]:
        stranger = Peer(autopilot.address[1], system, component)
        stranger.heartbeat()
        stranger.send(odometry((5, 5, 5), time=6.0))
        stranger.socket.close()
    link.poll()
    assert not link.state.armed
    np.testing.assert_allclose(link.state.state.position, [0, 0, 0])


def test_commands_by_hand(link, autopilot):
    autopilot.heartbeat()
    link.poll()
    # Twice the weight; roll right 0.1, nose down 0.2, turn left 0.3 rad/s.
    link.send([2.0 * 2.0 * 9.81, 0.1, 0.2, 0.3])
    (message,) = autopilot.received("SET_ATTITUDE_TARGET")
    rates = [message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate]
    np.testing.assert_allclose(rates, [0.1, -0.2, -0.3], rtol=1e-6)
    assert message.thrust == pytest.approx(0.8)
    assert message.type_mask == mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
    assert (message.target_system, message.target_component) == (1, 1)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 191)
    assert np.isfinite(message.q).all()
    assert link.sent == 1
    link.thrust_gain = 0.5  # half the thrust arrives
    link.send([2.0 * 9.81, 0.0, 0.0, 0.0])
    (message,) = autopilot.received("SET_ATTITUDE_TARGET")
    assert message.thrust == pytest.approx(0.8)


@pytest.mark.parametrize("command", [[1, 2, 3], [math.nan, 0, 0, 0], [9.8, math.inf, 0, 0], [[1, 2, 3, 4]]])
def test_invalid_commands_are_refused(link, autopilot, command):
    autopilot.heartbeat()
    link.poll()
    with pytest.raises(ValueError, match="finite"):
        link.send(command)
    assert autopilot.received("SET_ATTITUDE_TARGET") == []


def test_commands_go_to_the_autopilot_only(link, autopilot):
    link.send([9.81, 0, 0, 0])  # no autopilot has been heard yet
    assert link.sent == 0
    autopilot.heartbeat()
    link.poll()
    stranger = Peer(autopilot.address[1], 255, 190)
    stranger.heartbeat()
    link.poll()
    link.send([9.81, 0, 0, 0])
    assert len(autopilot.received("SET_ATTITUDE_TARGET")) == 1
    assert stranger.received("SET_ATTITUDE_TARGET") == []
    stranger.socket.close()


def test_only_commands_heartbeats_and_requests_for_states_are_sent(link, autopilot, clock):
    seen = {}
    for _ in range(200):
        clock.now += 0.05
        autopilot.heartbeat()
        autopilot.send(goal_message((1, 2, -3)))
        link.poll()
        link.send([9.81, 0, 0, 0])
        while True:
            try:
                messages = autopilot.parser.parse_buffer(autopilot.socket.recv(2048)) or []
            except BlockingIOError:
                break
            for message in messages:
                seen.setdefault(message.get_type(), []).append(message)
    assert set(seen) == {"SET_ATTITUDE_TARGET", "HEARTBEAT", "COMMAND_LONG"}
    assert {m.command for m in seen["COMMAND_LONG"]} == {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL}
    assert {m.type for m in seen["HEARTBEAT"]} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}
    assert len(seen["HEARTBEAT"]) == pytest.approx(10, abs=1)


def test_odometry_is_requested_until_it_arrives(link, autopilot, clock):
    autopilot.heartbeat()
    link.poll()
    requests = {request.param1: request.param2 for request in autopilot.received("COMMAND_LONG")}
    wanted = {"ODOMETRY": 1e4, "EXTENDED_SYS_STATE": 2e5, "DISTANCE_SENSOR": 1e5, "GPS_RAW_INT": 2e5}
    assert requests == {getattr(mavlink, f"MAVLINK_MSG_ID_{name}"): period for name, period in wanted.items()}
    for k in range(250):
        clock.now += 0.01
        autopilot.send(odometry(time=5.0 + 0.01 * k), *([landed_state(2), gnss(3)] if k % 20 == 0 else []))
        link.poll()
    autopilot.heartbeat()
    link.poll()
    (request,) = autopilot.received("COMMAND_LONG")
    assert request.param1 == mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR


def test_goals(link, autopilot):
    autopilot.heartbeat()
    (station := Peer(autopilot.address[1], 255, 190)).send(goal_message((10, 2, -3)))
    link.poll()
    np.testing.assert_allclose(link.goal, [10, -2, 3])
    for message in (goal_message((1, 1, 1), component=1), goal_message((1, 1, 1), system=7)):
        station.send(message)  # for the autopilot, for another vehicle
    unusable = goal_message((math.nan, 0, 0)), goal_message((1, 1, 1), mask=0b1), goal_message((1, 1, 1), frame=0)
    station.send(*unusable)
    link.poll()
    np.testing.assert_allclose(link.goal, [10, -2, 3])
    assert link.dropped == {"SET_POSITION_TARGET_LOCAL_NED in another frame, incomplete, or not finite": 3}
    station.socket.close()


def test_the_first_autopilot_is_pinned(link, autopilot, clock, caplog):
    state_after(link, autopilot, odometry((1, 2, -3)))
    impostors = Peer(autopilot.address[1]), Peer(autopilot.address[1])
    for k, impostor in enumerate(impostors):
        impostor.heartbeat()
        impostor.send(odometry((9, 9, 9), time=6.0 + k), landed_state(2))
        link.poll()
    np.testing.assert_allclose(link.state.state.position, [1, -2, 3])
    assert not link.state.armed and link.state.in_air is None
    link.send([9.81, 0, 0, 0])
    assert len(autopilot.received("SET_ATTITUDE_TARGET")) == 1
    assert not any(impostor.received("SET_ATTITUDE_TARGET") for impostor in impostors)
    # The address of a ground station is allowed, but not to pose as the autopilot.
    assert link.ignored["HEARTBEAT of the autopilot from 127.0.0.1"] == 2
    assert caplog.text.count("ignored: HEARTBEAT of the autopilot from 127.0.0.1; only the first autopilot") == 1
    for impostor in impostors:
        impostor.socket.close()


@pytest.fixture
def strict_link(clock, port):
    """A link that takes goals only from the vehicle."""
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", ThrustModel(), clock=clock)
    yield link
    link.close()


def test_goals_come_from_named_senders_only(strict_link, port, clock, caplog):
    autopilot, forwarded, station = Peer(port), Peer(port, 255, 190), Peer(port, 255, 190)
    autopilot.heartbeat()
    strict_link.poll()
    autopilot.send(goal_message((1, 0, 0)))
    strict_link.poll()
    np.testing.assert_allclose(strict_link.goal, [1, 0, 0])
    forwarded.socket.close()
    forwarded.socket = autopilot.socket  # a ground station whose messages the autopilot forwards
    for stranger in (forwarded, station):
        stranger.send(goal_message((7, 7, 7)))
        strict_link.poll()
    np.testing.assert_allclose(strict_link.goal, [1, 0, 0])
    assert "datagrams from 127.0.0.1" in caplog.text  # named in the log
    autopilot.socket.close()
    station.socket.close()


@pytest.mark.parametrize("entry", [(255, None), (255, "127.0.0.1")])
def test_a_ground_station_is_obeyed_only_on_the_way_that_was_named(clock, port, entry, caplog):
    link = MavlinkLink(f"udpin:127.0.0.1:{port}", ThrustModel(), goal_senders=[(1, None), entry], clock=clock)
    autopilot, forwarded, station = Peer(port), Peer(port, 255, 190), Peer(port, 255, 190)
    autopilot.heartbeat()
    forwarded.socket.close()
    forwarded.socket = autopilot.socket
    station.send(goal_message((2, 0, 0)))
    forwarded.send(goal_message((1, 0, 0)))
    link.poll()
    assert link.goal is not None
    np.testing.assert_allclose(link.goal, [1 if entry[1] is None else 2, 0, 0])
    if entry[1] is not None:
        assert link.ignored == {"goal from 255@autopilot": 1}
        assert "add 255@autopilot to mavlink.goal_senders to obey it" in caplog.text
    link.close()
    autopilot.socket.close()
    station.socket.close()


def test_a_flood_of_strangers_reaches_neither_parser_nor_buffer(strict_link, port, clock):
    autopilot, stranger = Peer(port), Peer(port, 1, 1)
    autopilot.heartbeat()
    strict_link.poll()
    for k in range(2000):
        stranger.send(odometry(time=5.0 + k))
        if k % 50 == 0:
            strict_link.poll()
    state_after(strict_link, autopilot, odometry((1, 2, 3)))
    np.testing.assert_allclose(strict_link.state.state.position, [1, -2, -3])  # the buffer had room for it
    assert strict_link.received == {"HEARTBEAT": 1, "ODOMETRY": 1} and strict_link.parser.bad == 0
    assert strict_link.strangers == 2000
    autopilot.socket.close()
    stranger.socket.close()


def test_garbage_does_not_swallow_later_messages(link, autopilot):
    good = bytes(odometry((1, 0, 0)).pack(autopilot.protocol))
    for bad in (b"\xfd\xff\x00", b"\xfe\xff", os.urandom(500), good[:-5], good[:40] + b"\x55" + good[41:], b""):
        autopilot.socket.sendto(bad, autopilot.address)
    link.poll()
    assert link.state is None
    assert link.parser.bad >= 4
    autopilot.socket.sendto(good, autopilot.address)
    link.poll()
    assert link.state is not None


def test_unknown_messages_are_skipped(link, autopilot):
    for number in (60_000, 60_001, 16_000_000):
        header = bytes([0xFD, 0, 0, 0, 0, 1, 1]) + number.to_bytes(3, "little")
        autopilot.socket.sendto(header + b"\0\0", autopilot.address)
    link.poll()
    assert link.received == {} and link.parser.skipped == 3


def test_a_flood_is_read_in_parts(link, autopilot, monkeypatch):
    monkeypatch.setattr(mavlink_module, "_DATAGRAMS_PER_POLL", 20)
    for _ in range(50):
        autopilot.send(odometry())
    for total in (20, 40, 50, 50):
        link.poll()
        assert link.received["ODOMETRY"] == total


def test_udpout_sends_first():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as autopilot:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(60.0)
        link = MavlinkLink(f"udpout:127.0.0.1:{autopilot.getsockname()[1]}", ThrustModel())
        link.poll()
        data, address = autopilot.recvfrom(2048)
        (heartbeat,) = mavlink.MAVLink(None).parse_buffer(data)
        assert heartbeat.get_type() == "HEARTBEAT"
        protocol = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        autopilot.sendto(bytes(odometry((1, 2, 3)).pack(protocol)), address)
        link.poll()
        assert link.state is not None
        link.close()


def test_serial_devices_are_streams():
    there, device = os.openpty()
    try:
        link = MavlinkLink(os.ttyname(device), ThrustModel(), baud=115_200)
        protocol = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for k in range(50):
            data = bytes(odometry((k, 0, 0), time=5.0 + 0.01 * k).pack(protocol))
            for part in (data[:7], data[7:100], data[100:]):  # at arbitrary positions
                os.write(there, part)
                link.poll()
            os.write(there, b"\x00\xfe")  # noise on the line
        assert link.received["ODOMETRY"] >= 49
        assert link.parser.buffered < 1000
        os.set_blocking(there, False)
        os.read(there, 65536)
        link.send([9.81, 0, 0, 0])
        (message,) = mavlink.MAVLink(None).parse_buffer(os.read(there, 65536))
        assert message.get_type() == "SET_ATTITUDE_TARGET"
        link.close()
    finally:
        os.close(there)
        os.close(device)
