"""The MAVLink connection over real sockets: commands, requests, goals, and who is obeyed."""

import math
import os
import socket

import numpy as np
import pytest

from aero_planner.onboard import mavlink as mavlink_module
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.thrust import ThrustModel
from tests.planner.onboard.mavlink_peer import (
    Peer,
    battery,
    gnss,
    goal_message,
    landed_state,
    mavlink,
    odometry,
    state_after,
    transmitter,
)


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
    assert set(seen) == {"SET_ATTITUDE_TARGET", "HEARTBEAT", "COMMAND_LONG", "TIMESYNC"}
    assert all(message.tc1 == 0 for message in seen["TIMESYNC"])
    requests = {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE}
    assert {m.command for m in seen["COMMAND_LONG"]} == requests
    assert {m.type for m in seen["HEARTBEAT"]} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}
    assert len(seen["HEARTBEAT"]) == pytest.approx(10, abs=1)


def interval_requests(autopilot):
    """Return the requests for periodic messages that have arrived."""
    interval = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    return [request for request in autopilot.received("COMMAND_LONG") if request.command == interval]


def test_odometry_is_requested_until_it_arrives(link, autopilot, clock):
    autopilot.heartbeat()
    link.poll()
    requests = {request.param1: request.param2 for request in interval_requests(autopilot)}
    wanted = {
        "ODOMETRY": 1e4, "EXTENDED_SYS_STATE": 2e5, "DISTANCE_SENSOR": 1e5, "GPS_RAW_INT": 2e5, "SYS_STATUS": 2e5,
        "BATTERY_STATUS": 1e6,
    }  # fmt: skip
    assert requests == {getattr(mavlink, f"MAVLINK_MSG_ID_{name}"): period for name, period in wanted.items()}
    for k in range(250):
        clock.now += 0.01
        reports = [landed_state(2), gnss(3), transmitter(True), battery(mavlink.MAV_BATTERY_CHARGE_STATE_OK)]
        autopilot.send(odometry(time=5.0 + 0.01 * k), *(reports if k % 20 == 0 else []))
        link.poll()
    autopilot.heartbeat()
    link.poll()
    (request,) = interval_requests(autopilot)
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


def test_a_flood_from_unknown_senders_reaches_neither_parser_nor_buffer(strict_link, port, clock):
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
    assert strict_link.dropped_datagrams == 2000
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
