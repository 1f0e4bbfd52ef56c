"""Missions over MAVLink, by the mission protocol, over real sockets."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission, Waypoint
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_mission import ITEMS_MAX, REQUEST_TIMEOUT, REQUESTS_MAX
from aero_planner.onboard.thrust import ThrustModel
from tests.planner.onboard.mavlink_peer import Peer, mavlink, mission_item, odometry, state_after
from tests.planner.onboard.simulated import Clock

NAMES = "MISSION_REQUEST_INT", "MISSION_ACK", "MISSION_CURRENT", "MISSION_ITEM_REACHED"
SPEED = mavlink.MAV_CMD_DO_CHANGE_SPEED


class Station(Peer):
    """A ground station that sends missions, and answers requests."""

    def __init__(self, port: int, link: MavlinkLink) -> None:
        super().__init__(port, 255, 190)
        self.link = link

    def ask(self, *messages: Any) -> list[Any]:
        self.send(*messages)
        self.link.poll()
        return self.received(*NAMES)

    def count(self, count: int, *, kind: int = 0, component: int = 191) -> list[Any]:
        return self.ask(mavlink.MAVLink_mission_count_message(1, component, count, kind))

    def clear(self) -> list[Any]:
        return self.ask(mavlink.MAVLink_mission_clear_all_message(1, 191))

    def upload(self, *items: Any, answer: str = "") -> list[Any]:
        """Send all items, let the node give its answer, and return what the link sends at the end."""
        messages = self.count(len(items))
        for item in items:
            if [(m.get_type(), getattr(m, "seq", None)) for m in messages] != [("MISSION_REQUEST_INT", item.seq)]:
                return messages
            messages = self.ask(item)
        if not messages and self.link.offer is not None:
            self.link.offer.answer = answer
            messages = self.ask()
        return messages


def result(messages: list[Any]) -> int:
    (message,) = messages
    assert (message.get_type(), message.target_system, message.target_component) == ("MISSION_ACK", 255, 190)
    return message.type


@pytest.fixture
def station(link: MavlinkLink, autopilot: Peer, port: int) -> Iterator[Station]:
    state_after(link, autopilot, odometry())
    station = Station(port, link)
    yield station
    station.socket.close()


def test_an_upload_becomes_a_mission_with_the_speed_of_each_leg(station: Station, link: MavlinkLink):
    items = [
        mission_item(0, (10, 2, -3), radius=2.0),
        mission_item(1, command=SPEED, param1=1.0, radius=3.0),
        mission_item(2, (20, 0, -3), hold=4.0),
        mission_item(3, command=SPEED, param1=1.0, radius=-2.0),
        mission_item(4, (30, 0, -3)),
    ]
    assert result(station.upload(*items)) == mavlink.MAV_MISSION_ACCEPTED
    assert link.offer is not None and link.offer.mission == Mission((
        Waypoint((10.0, -2.0, 3.0), radius=2.0),
        Waypoint((20.0, 0.0, 3.0), stop=True, hold=4.0, speed=3.0),
        Waypoint((30.0, 0.0, 3.0), stop=True),
    ))  # fmt: skip
    assert result(station.ask(items[-1])) == mavlink.MAV_MISSION_ACCEPTED, "the answer was lost, and is repeated"


def test_items_in_global_frames_are_placed_by_the_home_position(station: Station, link: MavlinkLink, autopilot: Peer):
    frames = mavlink.MAV_FRAME_GLOBAL_INT, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT
    place, heights = (47.001, 8.001), (503.0, 3.0)
    items = [mission_item(i, (*place, heights[i]), frame=frames[i], scale=1e7) for i in range(2)]
    assert result(station.upload(*items)) == mavlink.MAV_MISSION_UNSUPPORTED_FRAME
    autopilot.send(
        mavlink.MAVLink_home_position_message(470000000, 80000000, 500000, 1.0, 2.0, -0.5, [1, 0, 0, 0], 0, 0, 0)
    )
    assert result(station.upload(*items)) == mavlink.MAV_MISSION_ACCEPTED
    assert link.offer is not None and link.offer.mission is not None
    east = 111.19 * math.cos(math.radians(47.0005))
    for waypoint in link.offer.mission.waypoints:
        np.testing.assert_allclose(waypoint.position, [1.0 + 111.19, -2.0 - east, 3.5], atol=0.02)


@pytest.mark.parametrize(
    ("item", "wanted"),
    [
        (mission_item(0, command=mavlink.MAV_CMD_NAV_TAKEOFF), mavlink.MAV_MISSION_UNSUPPORTED),
        (mission_item(0, command=mavlink.MAV_CMD_NAV_LAND), mavlink.MAV_MISSION_UNSUPPORTED),
        (mission_item(0, (1, 0, -2), autocontinue=0), mavlink.MAV_MISSION_UNSUPPORTED),
        (mission_item(0, (1, 0, -2), frame=mavlink.MAV_FRAME_BODY_FRD), mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (mission_item(0, (1, 0, -2), hold=-1.0), mavlink.MAV_MISSION_INVALID_PARAM1),
        (mission_item(0, (1, 0, -2), hold=1e4), mavlink.MAV_MISSION_INVALID_PARAM1),
        (mission_item(0, (1, 0, -2), radius=-1.0), mavlink.MAV_MISSION_INVALID_PARAM2),
        (mission_item(0, (1, 0, -2), radius=math.inf), mavlink.MAV_MISSION_INVALID_PARAM2),
        (mission_item(0, (1, 0, -2), param3=5.0), mavlink.MAV_MISSION_INVALID_PARAM3),
        (mission_item(0, (1, 0, math.nan)), mavlink.MAV_MISSION_INVALID_PARAM7),
        (mission_item(0, command=SPEED, param1=2.0, radius=3.0), mavlink.MAV_MISSION_INVALID_PARAM1),
        (mission_item(0, command=SPEED, param1=1.0, radius=math.nan), mavlink.MAV_MISSION_INVALID_PARAM2),
        (mission_item(0, command=SPEED, param1=1.0, radius=3.0), mavlink.MAV_MISSION_INVALID),
    ],
)
def test_an_item_that_is_not_flown_is_refused(station: Station, link: MavlinkLink, item: Any, wanted: int):
    assert result(station.upload(item)) == wanted
    assert link.offer is None


def test_what_the_node_refuses_is_denied(station: Station):
    refused = station.upload(mission_item(0, (1, 0, -2)), answer="the drone is braking")
    assert result(refused) == mavlink.MAV_MISSION_DENIED


def test_requests_are_repeated_and_end(station: Station, link: MavlinkLink, clock: Clock):
    (first,) = station.count(2)
    assert (first.get_type(), first.seq) == ("MISSION_REQUEST_INT", 0)
    assert station.ask() == [], "it is not yet time"
    for _ in range(REQUESTS_MAX - 1):
        clock.now += REQUEST_TIMEOUT
        (again,) = station.ask()
        assert again.seq == 0
    clock.now += REQUEST_TIMEOUT
    assert station.ask() == [] and station.ask(mission_item(0, (1, 0, -2))) == [], "the upload has ended"
    assert result(station.upload(mission_item(0, (1, 0, -2)))) == mavlink.MAV_MISSION_ACCEPTED


def test_items_out_of_order_and_repeated_are_dropped(station: Station):
    station.count(2)
    assert station.ask(mission_item(1, (2, 0, -2))) == []
    (request,) = station.ask(mission_item(0, (1, 0, -2)))
    assert request.seq == 1 and station.ask(mission_item(0, (1, 0, -2))) == []


def test_what_cannot_be_received_is_answered(station: Station, port: int, link: MavlinkLink):
    assert result(station.count(ITEMS_MAX + 1)) == mavlink.MAV_MISSION_NO_SPACE
    assert result(station.count(1, kind=mavlink.MAV_MISSION_TYPE_FENCE)) == mavlink.MAV_MISSION_UNSUPPORTED
    asked = station.ask(mavlink.MAVLink_mission_request_list_message(1, 191))
    assert result(asked) == mavlink.MAV_MISSION_UNSUPPORTED
    assert station.count(1, component=1) == station.count(1, component=0) == [], "for the autopilot, or for all"
    station.count(2)
    other = Station(port, link)
    other.protocol.srcComponent = 191
    other.send(mavlink.MAVLink_mission_count_message(1, 191, 1))
    link.poll()
    (denied,) = other.received(*NAMES)
    assert denied.type == mavlink.MAV_MISSION_DENIED and denied.target_component == 191
    other.socket.close()
    ended = mavlink.MAVLink_mission_ack_message(1, 191, mavlink.MAV_MISSION_OPERATION_CANCELLED)
    assert station.ask(ended) == [] and station.ask(mission_item(0, (1, 0, -2))) == []


def test_missions_come_from_named_senders_only(port: int, clock: Clock, caplog: pytest.LogCaptureFixture):
    link = MavlinkLink(
        f"udpin:127.0.0.1:{port}", ThrustModel(), goal_senders=[(1, None), (255, "127.0.0.1")], clock=clock
    )
    autopilot = Peer(port)
    autopilot.heartbeat()
    link.poll()
    forwarded = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    autopilot.socket.sendto(bytes(mavlink.MAVLink_mission_count_message(1, 191, 1).pack(forwarded)), autopilot.address)
    link.poll()
    assert link.ignored == {"mission from 255@autopilot": 1} and autopilot.received(*NAMES) == []
    assert "add 255@autopilot to mavlink.goal_senders" in caplog.text
    link.close()
    autopilot.socket.close()


def test_a_mission_is_cleared(station: Station, link: MavlinkLink):
    for ask in (station.clear, lambda: station.count(0)):
        assert ask() == [] and link.offer is not None and link.offer.mission is None
        link.offer.answer = ""
        assert result(station.ask()) == mavlink.MAV_MISSION_ACCEPTED


def test_the_progress_is_told_in_the_numbers_of_the_items(station: Station, link: MavlinkLink, clock: Clock):
    items = (
        mission_item(0, command=SPEED, param1=1.0, radius=3.0),
        mission_item(1, (9, 0, -2)),
        mission_item(2, (18, 0, -2)),
    )
    station.upload(*items)
    assert link.offer is not None and link.offer.mission is not None
    progress = MissionProgress(link.offer.mission)

    def told() -> list[tuple[str, int]]:
        link.report_mission(progress)
        return [(message.get_type().removeprefix("MISSION_"), message.seq) for message in station.received(*NAMES)]

    assert told() == [("CURRENT", 1)] and told() == []
    clock.now += 1.0
    assert told() == [("CURRENT", 1)]
    for x in range(12):
        progress = progress.advance(0.1 * x, (float(x), 0.0, 2.0), 5.0)
    assert told() == [("ITEM_REACHED", 1), ("CURRENT", 2)]
    progress = progress.arrive(9.0, (18.0, 0.0, 2.0))
    link.report_mission(progress)
    reached, current = station.received(*NAMES)
    assert (reached.seq, current.seq) == (2, 2)
    assert (current.total, current.mission_state) == (3, mavlink.MISSION_STATE_COMPLETE)
    link.report_mission(None)
    clock.now += 5.0
    assert station.received(*NAMES) == []
