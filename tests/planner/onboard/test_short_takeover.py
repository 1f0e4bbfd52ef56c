"""A pilot who takes over for a moment, between two of PX4's heartbeats."""

import pytest

from aero_planner import Planner
from aero_planner.onboard.failsafe_table import Cause, State
from tests.planner.onboard.mavlink_peer import HOLD, OFFBOARD, mavlink, odometry, state_after
from tests.planner.onboard.simulated import in_flight

ACCEPTED, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
PERIOD = 0.02


def heartbeat_requests(autopilot) -> int:
    requests = autopilot.received("COMMAND_LONG")
    request = mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_HEARTBEAT
    return sum((message.command, message.param1) == request for message in requests)


@pytest.mark.parametrize("begin", [0.05, 0.33, 0.55])
def test_a_px4_that_answers_requests_tells_within_a_tenth_of_a_second(link, autopilot, clock, begin):
    autopilot.heartbeat()
    start, seen = clock.now, []
    for k in range(60):
        clock.now = start + PERIOD * k
        mode = HOLD if begin <= PERIOD * k < begin + 0.4 else OFFBOARD
        if heartbeat_requests(autopilot):
            autopilot.heartbeat(mode=mode)
        state_after(link, autopilot, odometry(time=5.0 + PERIOD * k))
        seen.append(link.state.offboard)
    taken = [PERIOD * k for k, offboard in enumerate(seen) if not offboard]
    assert begin <= taken[0] <= begin + 0.1 + PERIOD and len(taken) >= 14
    assert seen[-1]


def test_a_disarmed_vehicle_is_not_asked(link, autopilot, clock):
    for k in range(20):
        clock.now += 0.1
        autopilot.heartbeat(base=1)
        state_after(link, autopilot, odometry(time=5.0 + 0.1 * k))
    assert heartbeat_requests(autopilot) == 0


@pytest.mark.parametrize("command", ["DO_SET_MODE", "NAV_LAND", "NAV_RETURN_TO_LAUNCH", "COMPONENT_ARM_DISARM"])
def test_an_accepted_change_of_the_mode_counts_until_a_heartbeat_names_it(link, autopilot, clock, command):
    number = getattr(mavlink, f"MAV_CMD_{command}")
    autopilot.heartbeat()
    state_after(link, autopilot, odometry())
    heartbeat_requests(autopilot)
    state_after(link, autopilot, mavlink.MAVLink_command_ack_message(number, ACCEPTED))
    assert heartbeat_requests(autopilot) == 1  # at once
    for k in range(1, 12):  # but no heartbeat comes
        clock.now += PERIOD
        state_after(link, autopilot, odometry(time=5.0 + PERIOD * k))
        assert k == 5 or link.state.offboard is (k < 5)
    autopilot.heartbeat()
    link.poll()
    assert link.state.offboard


@pytest.mark.parametrize(
    "answer",
    [
        (mavlink.MAV_CMD_DO_SET_MODE, DENIED),
        (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, ACCEPTED),
        (mavlink.MAV_CMD_REQUEST_MESSAGE, ACCEPTED),
    ],
)
def test_other_acknowledgements_change_nothing(link, autopilot, clock, answer):
    autopilot.heartbeat()
    state_after(link, autopilot, odometry(), mavlink.MAVLink_command_ack_message(*answer))
    for k in range(1, 20):
        clock.now += PERIOD
        state_after(link, autopilot, odometry(time=5.0 + PERIOD * k))
        assert link.state.offboard


def test_the_node_flies_on_only_when_the_pilot_hands_over_again(small_planner: Planner):
    flight = in_flight(small_planner)
    flight.link.heartbeat_period = 0.1  # as asked for
    flight.run(0.25)
    flight.link.offboard, count = False, len(flight.node.changes)
    flight.run(0.1 + PERIOD)
    assert flight.node.state in (State.WAITING, State.READY)
    flight.run(0.28)
    flight.link.offboard = True
    flight.run(0.3)
    assert [change.cause for change in list(flight.node.changes)[count:]] == [
        Cause.TAKEN_OVER, Cause.STANDBY, Cause.ENGAGED,
    ]  # fmt: skip
