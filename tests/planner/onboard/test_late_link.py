"""A link to the autopilot that is late, from the start or in flight."""

import numpy as np
import pytest

from aero_planner import Planner
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.round_trips import RoundTrips
from tests.planner.onboard.mavlink_peer import mavlink, odometry, state_after
from tests.planner.onboard.simulated import in_flight

PERIOD = 0.02
BOOT = 5000.0
"""Host time at which the autopilot's clock was 0 [s]."""


class Late:
    """An autopilot at the other end of a link that takes `delay` [s] in each direction."""

    def __init__(self, link, autopilot, clock) -> None:
        self.link, self.autopilot, self.clock = link, autopilot, clock
        clock.now = BOOT + 10.0
        self.delay = 0.0
        self.on_the_way: list[tuple[float, object]] = []
        self.answers = True
        autopilot.heartbeat()
        link.poll()

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.clock.now += PERIOD
            now, stamp = self.clock.now, self.clock.now - BOOT
            self.on_the_way.append((now + self.delay, odometry(time=stamp)))
            for request in self.autopilot.received("TIMESYNC"):
                # It was sent a period ago, by the poll before.
                answer = mavlink.MAVLink_timesync_message(round(1e9 * (stamp - PERIOD + self.delay)), request.ts1)
                if self.answers and request.tc1 == 0:
                    self.on_the_way.append((now - PERIOD + 2.0 * self.delay, answer))
            for due, message in self.on_the_way:
                if due <= now + 1e-9:
                    self.autopilot.send(message)
            self.on_the_way = [(due, message) for due, message in self.on_the_way if due > now + 1e-9]
            self.link.poll()

    @property
    def age(self) -> float:
        return self.clock.now - self.link.state.time


@pytest.fixture
def late(link, autopilot, clock) -> Late:
    return Late(link, autopilot, clock)


def test_a_link_that_is_late_from_the_start_is_measured(late: Late):
    late.delay = 0.3
    late.run(3.0)
    assert late.link.state.round_trip == pytest.approx(0.6, abs=0.03)
    assert late.age == pytest.approx(0.3, abs=0.03)


def test_one_that_becomes_late_stays_so(late: Late):
    late.run(2.0)
    assert late.link.state.round_trip <= 0.04 and late.age == pytest.approx(0.0, abs=1e-6)
    late.delay = 0.15
    for seconds in (1.0, 10.0, 30.0):
        late.run(seconds)
        assert late.link.state.round_trip == pytest.approx(0.3, abs=0.03)
        assert late.age == pytest.approx(0.15, abs=0.03)
    late.delay = 0.0
    late.run(2.0)
    assert late.link.state.round_trip <= 0.04 and late.age == pytest.approx(0.0, abs=1e-6)


def test_without_answers_stamps_alone_count(late: Late):
    late.answers, late.delay = False, 0.1
    late.run(3.0)
    assert np.isnan(late.link.state.round_trip) and late.age == pytest.approx(0.0, abs=1e-6)


def test_answers_that_nobody_asked_for_count_nothing(link, autopilot, clock):
    autopilot.heartbeat()
    link.poll()
    clock.now += 0.2
    state_after(link, autopilot, odometry())
    requests = autopilot.received("TIMESYNC")
    assert len(requests) == 2 and all(request.tc1 == 0 for request in requests)
    for ts1 in (1, requests[0].ts1 + 1, -requests[0].ts1):
        autopilot.send(*[mavlink.MAVLink_timesync_message(10**9, ts1)] * 3)
    autopilot.send(*[mavlink.MAVLink_timesync_message(0, request.ts1) for request in requests])  # its own requests
    link.poll()
    assert np.isnan(link.state.round_trip)
    autopilot.send(*[mavlink.MAVLink_timesync_message(10**9, requests[0].ts1)] * 3)
    link.poll()
    assert np.isnan(link.state.round_trip)  # one answer counts once


def test_a_clock_that_was_set_is_believed_again():
    trips, now = RoundTrips(1.0), 100.0
    for boot in (40.0, 95.0):
        for _ in range(5):
            now += 0.15
            requested = trips.request(now)
            assert requested is not None and trips.answer(round(1e9 * (now + 0.05 - boot)), requested, now + 0.1)
        assert trips.max_offset(now + 0.1) == pytest.approx(boot + 0.02, abs=1e-3)
    assert np.isinf(trips.max_offset(now + 60.0)) and np.isnan(trips.median(now + 60.0))


def test_a_flight_on_a_late_link_ends(small_planner: Planner):
    flight = in_flight(small_planner)
    limit = flight.node.config.limits.round_trip
    flight.link.round_trip = 0.9 * limit
    flight.run(0.5)
    assert flight.node.state is State.FLYING
    flight.link.round_trip = 1.1 * limit
    flight.run(2.0 * PERIOD)
    assert flight.node.state is State.BRAKING and flight.node.changes[-1].cause is Cause.LINK_LATE
    assert flight.run_until(lambda: flight.node.state is State.HANDED_BACK, 20.0)
