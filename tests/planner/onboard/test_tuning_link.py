"""Changes of parameters over sockets: who may ask for them, and what becomes of messages that do not verify."""

import contextlib
import socket
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.sealed_channel import SealedChannel, new_nonce
from aero_planner.onboard.telemetry import Telemetry
from aero_planner.onboard.telemetry_protocol import Kind, Message, encode
from aero_planner.onboard.tuning import Tuning
from tests.planner.onboard.simulated import SMALL, Clock
from tests.planner.onboard.test_telemetry import Viewer
from tests.planner.onboard.test_tuning import FASTER, KEY, ONBOARD


class Holder(Viewer):
    """A viewer, who can seal messages."""

    def __init__(self, port: int, key: bytes = KEY) -> None:
        super().__init__(port)
        hello = self.read()
        assert hello is not None and hello.kind == Kind.HELLO
        self.own = new_nonce()
        self.channel = SealedChannel(key, hello.values["nonce"], self.own, is_node=False)
        self.planner = PlannerConfig.from_dict(hello.values["planner"])

    def send(self, values: dict[str, Any], kind: Kind = Kind.REQUEST) -> None:
        self.socket.sendall(encode(kind, values))

    def prove(self) -> dict[str, Any]:
        """Prove to hold the key, and return the status that says so."""
        self.send({**self.channel.seal({}), "nonce": self.own})
        return self.status(lambda values: "tag" in values)

    def request(self, changes: dict[str, Any], status: dict[str, Any]) -> dict[str, Any]:
        """Return a sealed request."""
        content = {"time": status["time"], "version": status["version"], "changes": changes, "confirmed": True}
        return self.channel.seal(content)

    def status(self, condition: Callable[[dict[str, Any]], object] = lambda _: True) -> dict[str, Any]:
        """Return the next status that meets the condition, opened if it is sealed; messages are from the node alone."""
        while (message := self.read()) is not None:
            if message.kind == Kind.STATUS and condition(message.values):
                return self.channel.open(message.values) if "tag" in message.values else message.values
        raise AssertionError("the connection has ended")

    def denied(self) -> str:
        return self.status(lambda values: values.get("denied"))["denied"]

    def answer(self) -> dict[str, Any]:
        """Return the next status with an answer."""
        while True:
            status = self.status()
            if status["request"] and not status["waits"]:
                return status


@pytest.fixture
def tuned() -> Iterator[tuple[Tuning, Telemetry]]:
    tuning = Tuning(SMALL, ONBOARD, KEY)
    with contextlib.closing(Telemetry(SMALL, ONBOARD, tuning=tuning)) as telemetry:
        yield tuning, telemetry


def test_a_change_is_answered_with_the_version_and_everyone_sees_it(tuned: tuple[Tuning, Telemetry]):
    tuning, telemetry = tuned
    holder, watcher = Holder(telemetry.port), Holder(telemetry.port)
    status = holder.prove()
    assert status["version"] == 0 and status["armed"] and watcher.status()["values"]["vehicle.speed_limit"] == 5.0
    holder.send(holder.request(FASTER, status))
    while not (status := holder.status())["waits"]:
        pass
    assert tuning.version == 0
    change = tuning.take(lambda _: None)
    assert change is not None
    telemetry.observe(change)
    answer = holder.answer()
    assert (answer["request"], answer["refused"], answer["version"]) == (2, "", 1)
    assert watcher.status(lambda values: values["version"] == 1)["values"]["vehicle.speed_limit"] == 6.0
    assert Holder(telemetry.port).planner == SMALL.replace(FASTER), "whoever connects later is told, too"


def forged(holder: Holder, status: dict[str, Any]) -> dict[str, Any]:
    return holder.request(FASTER, status) | {"text": holder.request({"vehicle.speed_limit": 1.0}, status)["text"]}


def replayed(holder: Holder, status: dict[str, Any]) -> dict[str, Any]:
    message = holder.request({"costs.q_track": 1e9}, status)  # refused, and harmless
    holder.send(message)
    holder.answer()
    return message


def reordered(holder: Holder, status: dict[str, Any]) -> dict[str, Any]:
    early = holder.request(FASTER, status)
    holder.send(holder.request({"costs.q_track": 1e9}, status))
    holder.answer()
    return early


def unsealed(holder: Holder, status: dict[str, Any]) -> dict[str, Any]:
    return {"time": status["time"], "version": 0, "changes": FASTER, "confirmed": True}


@pytest.mark.parametrize("attack", [forged, replayed, reordered, unsealed])
def test_a_message_that_does_not_verify_ends_the_right_to_change(tuned: tuple[Tuning, Telemetry], attack: Callable):
    tuning, telemetry = tuned
    holder = Holder(telemetry.port)
    status = holder.prove()
    holder.send(attack(holder, status))
    assert "a message was refused" in holder.denied()
    holder.send(holder.request(FASTER, status))  # a good one
    assert holder.denied() and tuning.take(lambda _: None) is None and tuning.config == SMALL


def test_a_change_that_waits_is_dropped_with_the_connection(tuned: tuple[Tuning, Telemetry]):
    tuning, telemetry = tuned
    for is_cut in (True, False):
        holder, other = Holder(telemetry.port), Holder(telemetry.port)
        holder.send(holder.request(FASTER, holder.prove()))
        while not holder.status()["waits"]:
            pass
        if is_cut:
            holder.socket.shutdown(socket.SHUT_RDWR)
            while telemetry.viewers > 1:
                other.status()
        else:
            holder.socket.sendall(b"?" * 100)
            holder.denied()
        assert tuning.take(lambda _: None) is None and tuning.config == SMALL
        other.socket.close()


@pytest.mark.parametrize("key", [bytes(32), b""])
def test_another_key_only_watches(tuned: tuple[Tuning, Telemetry], key: bytes):
    tuning, telemetry = tuned
    stranger = Holder(telemetry.port, key)
    status = stranger.status()
    stranger.send({**stranger.channel.seal({}), "nonce": stranger.own})
    assert "another key" in stranger.denied()
    stranger.send(stranger.request(FASTER, status))
    assert stranger.denied() and tuning.take(lambda _: None) is None


def test_a_recorded_connection_cannot_be_played_again(tuned: tuple[Tuning, Telemetry]):
    tuning, telemetry = tuned
    holder, thief = Holder(telemetry.port), Holder(telemetry.port)
    proof = {**holder.channel.seal({}), "nonce": holder.own}
    thief.send(proof)
    assert "another key" in thief.denied()
    holder.send(proof)
    status = holder.status(lambda values: "tag" in values)
    request = holder.request(FASTER, status)
    again = Holder(telemetry.port)
    again.prove()
    again.send(request)
    assert again.denied() and tuning.take(lambda _: None) is None


@pytest.mark.parametrize(
    "data",
    [b"GET / HTTP/1.1\r\n\r\n" * 9, np.random.default_rng(0).bytes(100_000), encode(Kind.REQUEST, {}),
     encode(Kind.REQUEST, {"nonce": 5}), encode(Kind.REQUEST, {"nonce": "0" * 32, "x": "y" * 70_000})],
)  # fmt: skip
def test_garbage_from_viewers_leaves_them_watching(tuned: tuple[Tuning, Telemetry], data: bytes):
    _, telemetry = tuned
    viewer, other = Holder(telemetry.port), Holder(telemetry.port)
    viewer.socket.sendall(data)
    assert viewer.denied()
    viewer.socket.sendall(data)
    assert viewer.status()["version"] == 0 and other.prove()["version"] == 0


def test_a_node_without_a_key_discards_what_viewers_send(clock: Clock):
    with contextlib.closing(Telemetry(SMALL, ONBOARD, clock=clock)) as telemetry:
        viewer = Viewer(telemetry.port)
        hello = viewer.read()
        assert isinstance(hello, Message) and "nonce" not in hello.values
        viewer.socket.sendall(encode(Kind.REQUEST, {"changes": FASTER}))
        telemetry.observe(StateChange(12.5, State.FLYING, State.BRAKING, Cause.CLOUD_STALE))
        message = viewer.read()
        assert message is not None and message.kind == Kind.CHANGE
