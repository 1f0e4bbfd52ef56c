"""The mission protocol of MAVLink: receives missions, and reports the progress.

An upload is MISSION_COUNT, then one MISSION_ITEM_INT for each MISSION_REQUEST_INT, then MISSION_ACK. Missions are not
sent back: who has sent one knows it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission
from aero_planner.onboard.mavlink_items import HomePosition, ItemError, ItemReader
from aero_planner.onboard.mission_offer import MissionOffer
from aero_planner.onboard.transport import Address

_log = logging.getLogger(__name__)

REQUEST_TIMEOUT, REQUESTS_MAX = 0.25, 6
"""Time after which an item is requested again [s], and the number of requests: the protocol's 5 retries."""
ITEMS_MAX = 1000
"""Largest number of items of a mission."""
_REPORT_PERIOD = 1.0
"""Time between two MISSION_CURRENT [s]."""


@dataclass(frozen=True)
class Sender:
    """Who sends a mission."""

    system: int
    component: int
    address: Address | None
    """Where it sends from; None if the autopilot forwards its messages."""


@dataclass(eq=False)
class _Upload:
    sender: Sender
    count: int
    items: ItemReader
    received: int = 0
    requests: int = 0
    requested: float = 0.0
    offer: MissionOffer | None = None
    """What the node decides on; None before the last item."""
    result: int | None = None
    """The answer, a MAV_MISSION_RESULT; None before it."""


@dataclass(eq=False)
class MissionReceiver:
    """The node's end of the protocol. Called by one thread.

    Args:
        dialect: pymavlink's module of messages.
        system, component: ids of this computer, to which missions are addressed.
        clock: host time [s].
        send: sends a message, to an address, or to the autopilot if that is None.

    Attributes:
        offer: the last mission received, or the request to clear it; None before the first.
    """

    MESSAGES = ("MISSION_COUNT", "MISSION_ITEM_INT", "MISSION_CLEAR_ALL", "MISSION_REQUEST_LIST", "MISSION_ACK")
    """Names of the messages that `process` takes."""

    dialect: Any
    system: int
    component: int
    clock: Callable[[], float]
    send: Callable[[Any, Address | None], object]
    offer: MissionOffer | None = None
    home: HomePosition | None = field(default=None, init=False)
    _upload: _Upload | None = field(default=None, init=False)
    _taken: _Upload | None = field(default=None, init=False)
    _reported: tuple[float, int, int, int] = field(default=(-1e9, -1, -1, 0), init=False)
    """Time [s], number and state of the newest MISSION_CURRENT, and how many events were reported."""
    _mission: Mission | None = field(default=None, init=False)

    def is_addressed(self, message: Any) -> bool:
        """Return True if a message is for this component, not only for all: an autopilot would answer, too."""
        return (message.target_system, message.target_component) == (self.system, self.component)

    def set_home(self, message: Any) -> None:
        """Take the autopilot's HOME_POSITION, with which items in global frames can be placed."""
        self.home = HomePosition.from_message(message)

    def process(self, message: Any, address: Address | None) -> None:
        """Process a message from an accepted sender."""
        d, name = self.dialect, message.get_type()
        sender = Sender(message.get_srcSystem(), message.get_srcComponent(), address)
        if name == "MISSION_ACK":
            if self._upload is not None and self._upload.sender == sender and self._upload.offer is None:
                _log.warning("the sender has ended the upload of a mission")
                self._upload = None
        elif message.mission_type != d.MAV_MISSION_TYPE_MISSION:
            self._acknowledge(sender, d.MAV_MISSION_UNSUPPORTED, message.mission_type)
        elif name == "MISSION_REQUEST_LIST":
            self._acknowledge(sender, d.MAV_MISSION_UNSUPPORTED)
        elif name == "MISSION_ITEM_INT":
            self._take_item(sender, message)
        elif self._is_busy(sender):
            self._acknowledge(sender, d.MAV_MISSION_DENIED)
        elif name == "MISSION_CLEAR_ALL" or message.count == 0:
            self._offer(_Upload(sender, 0, self._reader()), None)
        elif message.count > ITEMS_MAX:
            self._acknowledge(sender, d.MAV_MISSION_NO_SPACE)
        else:
            self._upload = _Upload(sender, message.count, self._reader())
            self._request(self._upload)

    def step(self) -> None:
        """Answer once the node has decided, and repeat a request that was not answered."""
        upload, d = self._upload, self.dialect
        if upload is None or upload.result is not None:
            return
        if upload.offer is not None:
            if upload.offer.answer is not None:
                is_taken = upload.offer.answer == ""
                self._taken = upload if is_taken else self._taken
                self._finish(upload, d.MAV_MISSION_ACCEPTED if is_taken else d.MAV_MISSION_DENIED)
        elif self.clock() - upload.requested >= REQUEST_TIMEOUT:
            if upload.requests < REQUESTS_MAX:
                self._request(upload)
            else:
                _log.warning("the upload of a mission ends: item %d did not arrive", upload.received)
                self._upload = None

    def report(self, progress: MissionProgress | None) -> None:
        """Send MISSION_CURRENT when it has changed or a second has passed, and MISSION_ITEM_REACHED for each event."""
        if progress is None:
            self._mission = None
            return
        d, now = self.dialect, self.clock()
        sent, number, state, events = self._reported
        if progress.mission is not self._mission:
            self._mission, sent, events = progress.mission, -1e9, 0
        taken = self._taken
        if taken is None or taken.offer is None or taken.offer.mission is not progress.mission:
            taken = None  # the mission of the settings: its waypoints are the items
        numbers = range(len(progress.mission)) if taken is None else taken.items.numbers
        address = None if taken is None else taken.sender.address
        for event in progress.events[events:]:
            if event.kind != "given_up":
                self.send(d.MAVLink_mission_item_reached_message(numbers[event.waypoint]), address)
        current = numbers[min(progress.index, len(numbers) - 1)]
        present = d.MISSION_STATE_COMPLETE if progress.is_over else d.MISSION_STATE_ACTIVE
        if now - sent >= _REPORT_PERIOD or (current, present) != (number, state):
            total = len(progress.mission) if taken is None else taken.count
            self.send(d.MAVLink_mission_current_message(current, total, present), address)
            sent = now
        self._reported = sent, current, present, len(progress.events)

    def _reader(self) -> ItemReader:
        return ItemReader(self.dialect, self.home)

    def _is_busy(self, sender: Sender) -> bool:
        """Return True while the node decides, or another sender's upload is under way."""
        upload = self._upload
        return upload is not None and upload.result is None and (upload.sender != sender or upload.offer is not None)

    def _take_item(self, sender: Sender, message: Any) -> None:
        upload = self._upload
        if upload is None or upload.sender != sender:
            return
        if upload.result is not None:
            if message.seq == upload.received - 1:  # the answer was lost
                self._acknowledge(sender, upload.result)
            return
        if upload.offer is not None or message.seq != upload.received:
            return  # it is requested again, or it was repeated
        try:
            upload.received += 1
            upload.items.add(message)
            if upload.received < upload.count:
                upload.requests = 0
                self._request(upload)
            else:
                self._offer(upload, upload.items.mission())
        except ItemError as error:
            _log.error("the mission is refused: item %d: %s", message.seq, error)
            self._finish(upload, error.result)

    def _offer(self, upload: _Upload, mission: Mission | None) -> None:
        self.offer = upload.offer = MissionOffer(mission)
        self._upload = upload

    def _request(self, upload: _Upload) -> None:
        upload.requests, upload.requested = upload.requests + 1, self.clock()
        target = upload.sender.system, upload.sender.component
        message = self.dialect.MAVLink_mission_request_int_message(*target, upload.received)
        self.send(message, upload.sender.address)

    def _finish(self, upload: _Upload, result: int) -> None:
        upload.result = result
        self._acknowledge(upload.sender, result)

    def _acknowledge(self, sender: Sender, result: int, kind: int = 0) -> None:
        target = sender.system, sender.component
        self.send(self.dialect.MAVLink_mission_ack_message(*target, result, kind), sender.address)
