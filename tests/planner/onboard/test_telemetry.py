import contextlib
import dataclasses
import socket
import struct
import threading
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import PlannerConfig, Sweeps
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.interfaces import PlanRecord
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import PLAN_ARRAYS, POINT_STEP, Telemetry, encode_plan
from aero_planner.onboard.telemetry_protocol import Kind, Message, MessageReader, encode
from tests.planner.onboard.simulated import Clock

CHANGE = StateChange(12.5, State.FLYING, State.BRAKING, Cause.CLOUD_STALE)


class Viewer:
    """A connection that reads one message at a time."""

    def __init__(self, port: int, *, buffer: int | None = None) -> None:
        self.socket = socket.socket()
        self.socket.settimeout(60.0)
        if buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
        self.socket.connect(("127.0.0.1", port))
        self._reader, self._ready = MessageReader(), []

    def read(self) -> Message | None:
        """Return the next message; None at the end."""
        while not self._ready:
            try:
                data = self.socket.recv(1 << 16)
            except ConnectionError:
                return None
            if not data:
                return None
            self._ready += self._reader.feed(data)
        return self._ready.pop(0)

    def read_plan(self) -> Message:
        while (message := self.read()) is not None:
            if message.kind == Kind.PLAN:
                return message
        raise AssertionError("the connection has ended")


@pytest.fixture
def serve(clock: Clock) -> Iterator[Callable[..., Telemetry]]:
    with contextlib.ExitStack() as stack:

        def make(**changes: Any) -> Telemetry:
            settings = {"port": 0, "rate": 10.0, **changes}
            config = OnboardConfig().replace({f"telemetry.{name}": value for name, value in settings.items()})
            telemetry = Telemetry(PlannerConfig(), config, clock=clock)
            stack.callback(telemetry.close)
            return telemetry

        yield make


def send(telemetry: Telemetry, record: PlanRecord, clock: Clock) -> None:
    """Offer a plan when the next one is due."""
    clock.now += 1.0
    telemetry.observe(record)


def test_a_viewer_gets_the_configuration_and_then_plans(serve, clock: Clock, records: list[PlanRecord]):
    telemetry = serve(points_max=1_000_000)
    viewer = Viewer(telemetry.port)
    hello = viewer.read()
    assert hello is not None and hello.kind == Kind.HELLO
    assert PlannerConfig.from_dict(hello.values["planner"]) == PlannerConfig()
    assert hello.values["onboard"]["telemetry"]["port"] == 0
    record = records[-1]
    send(telemetry, record, clock)
    message = viewer.read_plan()
    for name in PLAN_ARRAYS:
        np.testing.assert_array_equal(message.arrays[name], getattr(record.plan, name))
    np.testing.assert_array_equal(message.arrays["continued_cells"] != 0, record.plan.continued_cells)
    assert tuple(message.values["kinds"]) == record.plan.kinds
    assert message.values["best"] == record.plan.best and message.values["safety"] == record.safety.name
    position = np.asarray(record.measured.position)
    np.testing.assert_array_equal(message.arrays["measured.position"], position)
    seen = position + message.arrays["points"] * POINT_STEP
    np.testing.assert_allclose(seen, record.points, atol=0.51 * POINT_STEP + 1e-5)


def test_points_are_thinned_and_their_coordinates_bounded(records: list[PlanRecord]):
    record = records[-1]
    for most in (0, 1, 10, 777, 10**6):
        (message,) = MessageReader().feed(encode_plan(record, points_max=most))
        assert len(message.arrays["points"]) <= most
        assert len(message.arrays["points"]) >= min(most, len(record.points)) // 2
    odd = np.array([[1e9, -1e9, np.nan], [np.inf, 0.0, 2.0]], dtype=np.float32)
    (message,) = MessageReader().feed(encode_plan(dataclasses.replace(record, cloud=Sweeps([odd])), points_max=10))
    assert np.abs(message.arrays["points"]).max() == 32767


def test_the_rate_is_limited_and_without_viewers_nothing_is_sent(serve, clock: Clock, records: list[PlanRecord]):
    telemetry = serve(rate=10.0)
    send(telemetry, records[0], clock)
    assert telemetry.sent == 0
    viewer = Viewer(telemetry.port)
    assert viewer.read() is not None
    numbers = []
    for tick in range(101):  # 2 s at 50 Hz
        clock.now = 200.0 + 0.02 * tick
        before = telemetry.accepted
        telemetry.observe(records[0])
        if telemetry.accepted != before:
            numbers.append(viewer.read_plan().values["number"])
    assert 20 <= len(numbers) <= 22 and telemetry.sent == len(numbers)


def test_a_stalled_viewer_delays_no_other_viewer(serve, clock: Clock, records: list[PlanRecord]):
    telemetry = serve()
    stuck, quick = Viewer(telemetry.port, buffer=4096), Viewer(telemetry.port)
    assert stuck.read() is not None and quick.read() is not None
    for _ in range(100):  # more than the system's buffers hold
        send(telemetry, records[-1], clock)
        assert quick.read_plan().values["number"] == records[-1].number
        if telemetry.skipped > 3:
            break
    assert telemetry.skipped > 3
    clock.now += 60.0  # after the timeout for a stalled viewer
    while telemetry.viewers > 1:
        send(telemetry, records[-1], clock)
        quick.read_plan()
    while stuck.read() is not None:
        pass


def test_data_from_viewers_is_discarded(serve, clock: Clock, records: list[PlanRecord]):
    telemetry = serve()
    viewer = Viewer(telemetry.port)
    assert viewer.read() is not None
    for size in (1, 20, 100_000):
        viewer.socket.sendall(np.random.default_rng(size).bytes(size))
        viewer.socket.sendall(b"GET / HTTP/1.1\r\n\r\n")
        send(telemetry, records[-1], clock)
        viewer.read_plan()


def test_viewers_come_and_go(serve, clock: Clock, records: list[PlanRecord]):
    telemetry = serve(clients_max=2)
    for _ in range(3):
        first, second = Viewer(telemetry.port), Viewer(telemetry.port)
        assert first.read() is not None and second.read() is not None
        third = Viewer(telemetry.port)
        assert third.read() is None  # too many viewers
        # One disconnects in the middle of a message, as when the network fails.
        first.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        first.socket.close()
        while telemetry.viewers > 1:
            send(telemetry, records[-1], clock)
            second.read_plan()
        second.socket.close()
        while telemetry.viewers:
            telemetry.observe(CHANGE)


def test_transitions_are_sent(serve):
    telemetry = serve()
    telemetry.observe(CHANGE)
    viewer = Viewer(telemetry.port)
    assert viewer.read() is not None
    telemetry.observe(CHANGE)
    message = viewer.read()
    assert message is not None and message.kind == Kind.CHANGE
    assert message.values == {
        "time": 12.5, "source": "FLYING", "target": "BRAKING", "cause": Cause.CLOUD_STALE.value,
    }  # fmt: skip


def test_closing_ends_connections_and_the_thread(serve):
    telemetry = serve()
    viewer = Viewer(telemetry.port)
    assert viewer.read() is not None
    telemetry.close()
    assert viewer.read() is None
    telemetry.close()
    telemetry.observe(CHANGE)  # has no effect
    assert not any(thread.name == "aero-planner-telemetry" for thread in threading.enumerate())


def test_a_port_in_use_is_an_error(serve):
    telemetry = serve()
    with pytest.raises(OSError):
        serve(port=telemetry.port)


# --- the messages ---

ARRAYS = {
    "a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.zeros((0, 3), np.float64),
    "c": np.arange(3, dtype=np.int16), "d": np.array(7.5), "e": np.arange(4, dtype=">i4"), "f": np.ones(5, np.uint8),
}  # fmt: skip
MESSAGE = encode(Kind.PLAN, {"x": 1.5, "y": ["a", None]}, ARRAYS)


def test_messages_are_decoded_from_any_pieces():
    for size in (1, 7, 4096):
        reader, found = MessageReader(), []
        data = MESSAGE * 3
        for start in range(0, len(data), size):
            found += reader.feed(data[start : start + size])
        assert len(found) == 3
        for message in found:
            assert message.kind == Kind.PLAN and message.values == {"x": 1.5, "y": ["a", None]}
            for name, array in ARRAYS.items():
                np.testing.assert_array_equal(message.arrays[name], array)
                assert message.arrays[name].shape == array.shape


def header(**changes: int | bytes) -> bytes:
    values = dict(magic=b"AERO", version=1, kind=2, length=100, size=100, checksum=0) | changes
    return struct.pack("<4sHHIII", *values.values())


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n", "no aero-planner node"),
        (header(version=2), "uses version 2 of the telemetry protocol and this program version 1"),
        (header(length=2**31), "impossible length"),
        (header(length=0), "impossible length"),
        (header(size=2**31), "impossible length"),
        (header() + bytes(100), "checksum is wrong"),
        (MESSAGE[:-1] + b"?", "checksum is wrong"),
    ],
)
def test_data_that_is_not_a_message_is_refused(data: bytes, problem: str):
    with pytest.raises(ValueError, match=problem):
        MessageReader().feed(data)


def packed(content: bytes, size: int | None = None) -> bytes:
    data = zlib.compress(content)
    return header(length=len(data), size=len(content) if size is None else size, checksum=zlib.crc32(data)) + data


@pytest.mark.parametrize(
    "data",
    [
        packed(b"\xff\xff\xff\xff"),
        packed(struct.pack("<I", 2) + b"{}"),
        packed(struct.pack("<I", 2) + b"[]"),
        packed(struct.pack("<I", 40) + b'{"values":{},"arrays":[["a","|O8",[1]]]}' + bytes(8)),
        packed(struct.pack("<I", 41) + b'{"values":{},"arrays":[["a","<f4",[-1]]]}'),
        packed(struct.pack("<I", 47) + b'{"values":{},"arrays":[["a","<f4",[1000000000]]]}'),
        packed(struct.pack("<I", 61) + b'{"values":{},"arrays":[["a","<f4",[1180591620717411303424]]]}'),
        packed(bytes(100), size=200),
        packed(bytes(10_000_000), size=100),  # expands beyond its announced size
        header(length=4, size=100, checksum=zlib.crc32(b"nope")) + b"nope",
    ],
)
def test_damaged_content_is_refused(data: bytes):
    with pytest.raises(ValueError, match="damaged"):
        MessageReader().feed(data)


@settings(max_examples=200, deadline=None)
@given(st.binary(max_size=200), st.integers(0, len(MESSAGE)), st.booleans())
def test_arbitrary_bytes_raise_only_value_error(noise: bytes, at: int, valid_checksum: bool):
    data = bytearray(MESSAGE)
    data[at : at + len(noise)] = noise[: len(data) - at]
    if valid_checksum and at > 20:
        data[16:20] = struct.pack("<I", zlib.crc32(data[20:]))
    with contextlib.suppress(ValueError):
        MessageReader().feed(bytes(data))


def test_unsendable_arrays_are_refused():
    with pytest.raises(ValueError, match="a has type complex128"):
        encode(Kind.PLAN, {}, {"a": np.zeros(1, complex)})
    with pytest.raises(ValueError, match="send fewer points"):
        encode(Kind.PLAN, {}, {"a": np.zeros(40_000_000, np.uint8)})
