"""Signatures, with pymavlink at the other end of the connection."""

import hashlib
import os
import select
import socket
import time

import numpy as np
import pytest

from aero_planner.config import VehicleConfig
from aero_planner.onboard.connections import make_sender, open_link
from aero_planner.onboard.dead_reckoning import MotionState
from aero_planner.onboard.failsafe_process import FailsafeGuard
from aero_planner.onboard.heartbeat_memory import HeartbeatMemory
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.mavlink_signing import load_key
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.signing_memory import state_folder as state_folder_of_the_node
from aero_planner.onboard.transport import open_transport
from aero_planner.onboard.watchdog import Heartbeat

mavlink = load_dialect()
KEY = bytes(range(32))
PYMAVLINK_EPOCH = 1420070400


class Autopilot:
    """An autopilot that signs with pymavlink and, with a key, refuses what is not signed."""

    def __init__(self, key: bytes | None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.port = self.socket.getsockname()[1]
        self.protocol = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.protocol.robust_parsing = True
        self.peer = ("127.0.0.1", 0)
        if key is not None:
            self.protocol.signing.secret_key, self.protocol.signing.sign_outgoing = key, True
            self.protocol.signing.timestamp = int((time.time() - PYMAVLINK_EPOCH) * 1e5)

    def heartbeat(self, mode: int = 0) -> bytes:
        return bytes(mavlink.MAVLink_heartbeat_message(2, 12, 129, mode, 4, 3).pack(self.protocol))

    def send(self, data: bytes, address: object = None) -> None:
        self.socket.sendto(data, self.peer)

    def receive(self) -> list[str]:
        """Return the names of all messages, once there are some."""
        assert select.select([self.socket], [], [], 60.0)[0]
        names = []
        while True:
            try:
                data, self.peer = self.socket.recvfrom(2048)
            except BlockingIOError:
                return names
            names += [message.get_type() for message in self.protocol.parse_buffer(data) or []]


@pytest.fixture
def key_file(tmp_path):
    path = tmp_path / "key"
    path.write_text(KEY.hex())
    return path


def connect(autopilot: Autopilot, key_file=None) -> MavlinkLink:
    changes = {"mavlink.url": f"udpout:127.0.0.1:{autopilot.port}"}
    if key_file is not None:
        changes["mavlink.signing_key_file"] = str(key_file)
    link = open_link(OnboardConfig().replace(changes), VehicleConfig())
    link.poll()  # sends a heartbeat
    return link


def test_pymavlink_accepts_signed_commands_and_only_those(key_file):
    for link_key, expected in ((key_file, "SET_ATTITUDE_TARGET"), (None, "BAD_DATA")):
        autopilot = Autopilot(KEY)
        link = connect(autopilot, link_key)
        autopilot.receive()
        link.send([9.81, 0, 0, 0])
        assert autopilot.receive() == [expected]
        link.close()


def test_the_failsafe_process_signs_on_a_link_of_its_own(key_file):
    autopilot = Autopilot(KEY)
    link = connect(autopilot, key_file)
    link.send([9.81, 0, 0, 0])
    config = OnboardConfig().replace({"mavlink.signing_key_file": str(key_file)})
    sender = make_sender(config, VehicleConfig())
    assert link.peer is not None
    sender.transport = transport = open_transport(link.peer, baud=None)
    sender.send([9.81, 0, 0, 0])
    link.send([9.81, 0, 0, 0])
    assert autopilot.receive()[-3:] == ["SET_ATTITUDE_TARGET"] * 3
    link.close()
    transport.close()


def test_messages_without_a_valid_signature_are_ignored(key_file):
    genuine, unsigned, other = Autopilot(KEY), Autopilot(None), Autopilot(bytes(32))
    link = connect(genuine, key_file)
    genuine.receive()
    first = genuine.heartbeat()
    forged = bytearray(genuine.heartbeat())
    forged[-12:-6] = b"\xff" * 6  # a time stamp from the future, which must not lock out the genuine sender
    damaged = bytearray(genuine.heartbeat())
    damaged[-1] ^= 1
    for data in (unsigned.heartbeat(), other.heartbeat(), bytes(forged), bytes(damaged)):
        genuine.send(data)
    link.poll()
    assert link.received == {} and link.parser.unsigned == 4
    second = genuine.heartbeat()
    genuine.send(second)
    link.poll()
    assert link.received == {"HEARTBEAT": 1}
    for replayed in (second, first):
        genuine.send(replayed)
    link.poll()
    assert link.received == {"HEARTBEAT": 1} and link.parser.unsigned == 6
    link.close()


def test_time_stamps_follow_an_autopilot_whose_clock_is_ahead(key_file):
    autopilot = Autopilot(KEY)
    autopilot.protocol.signing.timestamp += 10 * 60 * 100_000
    link = connect(autopilot, key_file)
    autopilot.receive()
    link.send([9.81, 0, 0, 0])
    autopilot.receive()
    autopilot.send(autopilot.heartbeat())
    link.poll()
    link.send([9.81, 0, 0, 0])
    assert autopilot.receive()[-1] == "SET_ATTITUDE_TARGET"
    link.close()


def test_the_failsafe_process_follows_an_autopilot_whose_clock_is_ahead(key_file):
    autopilot = Autopilot(KEY)
    autopilot.protocol.signing.timestamp += 10 * 60 * 100_000
    link = connect(autopilot, key_file)
    autopilot.receive()
    autopilot.send(autopilot.heartbeat())
    link.poll()
    config = OnboardConfig().replace({"mavlink.signing_key_file": str(key_file)})
    file = HeartbeatMemory.create_file()
    memory = HeartbeatMemory(file)
    guard = FailsafeGuard(HeartbeatMemory(file), config, VehicleConfig())
    os.close(file)
    hover = np.array([9.81, 0.0, 0.0, 0.0])
    motion = MotionState(0.0, np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    memory.write(Heartbeat(0.0, motion, hover), link.peer, link.min_signing_time)
    guard.check(0.02, is_alone=True)
    assert autopilot.receive()[-1] == "SET_ATTITUDE_TARGET"
    guard.close()
    link.close()


def test_keys_are_hexadecimal_or_passphrases(tmp_path):
    path = tmp_path / "key"
    path.write_text(f"{KEY.hex()}\n")
    assert load_key(path) == KEY
    path.write_text("correct horse\n")
    assert load_key(path) == hashlib.sha256(b"correct horse").digest()
    path.write_text("  \n")
    with pytest.raises(ValueError, match="is empty"):
        load_key(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="not a text file"):
        load_key(path)
    with pytest.raises(ValueError, match="No such file"):
        load_key(tmp_path / "absent")


def set_clock(monkeypatch: pytest.MonkeyPatch, now: float) -> None:
    monkeypatch.setattr("aero_planner.onboard.mavlink_signing.time.time", lambda: now)


def restarted(autopilot: Autopilot, key_file, *frames: bytes) -> dict[str, int]:
    """Return what a node that starts now accepts of these frames."""
    link = connect(autopilot, key_file)
    autopilot.receive()
    for frame in frames:
        autopilot.send(frame)
    link.poll()
    link.close()
    return link.received


def test_nothing_is_accepted_again_after_a_restart(key_file, state_folder):
    autopilot = Autopilot(KEY)
    seen = [autopilot.heartbeat(), autopilot.heartbeat()]
    assert restarted(autopilot, key_file, *seen) == {"HEARTBEAT": 2}
    assert restarted(autopilot, key_file, *seen) == {}
    assert restarted(autopilot, key_file, seen[1], autopilot.heartbeat()) == {"HEARTBEAT": 1}
    (file,) = state_folder.iterdir()
    assert KEY.hex() not in file.read_text() and KEY.hex()[:16] not in file.name


def test_nothing_is_accepted_again_after_a_crash(key_file, state_folder):
    autopilot = Autopilot(KEY)
    link = connect(autopilot, key_file)
    autopilot.receive()
    seen = autopilot.heartbeat()
    autopilot.send(seen)
    link.poll()
    deadline = time.monotonic() + 60.0
    while not next(state_folder.glob("signing_*")).read_text():  # not a file that is still being written
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert restarted(autopilot, key_file, seen) == {}
    later = Autopilot(KEY)
    later.protocol.signing.timestamp += 3 * 100_000
    assert restarted(later, key_file, later.heartbeat()) == {"HEARTBEAT": 1}
    link.close()


def test_the_date_may_be_lost_but_not_what_was_accepted(key_file, monkeypatch):
    autopilot = Autopilot(KEY)
    old, seen, fresh = (autopilot.heartbeat() for _ in range(3))
    assert restarted(autopilot, key_file, seen) == {"HEARTBEAT": 1}
    set_clock(monkeypatch, 0.0)
    assert restarted(autopilot, key_file, old, seen) == {}
    assert restarted(autopilot, key_file, fresh) == {"HEARTBEAT": 1}


def test_without_a_date_a_new_sender_is_not_believed(key_file, monkeypatch):
    autopilot = Autopilot(KEY)
    autopilot.protocol.signing.timestamp -= 86_400 * 100_000
    yesterday = autopilot.heartbeat()
    for now in (0.0, 1_500_000_000.0):
        set_clock(monkeypatch, now)
        assert restarted(autopilot, key_file, yesterday) == {}
    monkeypatch.undo()


def test_time_stamps_never_go_back_over_a_restart(key_file, monkeypatch):
    autopilot = Autopilot(KEY)
    autopilot.protocol.signing.timestamp += 600 * 100_000
    assert restarted(autopilot, key_file, autopilot.heartbeat()) == {"HEARTBEAT": 1}
    set_clock(monkeypatch, 0.0)
    link = connect(autopilot, key_file)
    assert link.min_signing_time >= autopilot.protocol.signing.timestamp - 1
    link.close()


def test_a_memory_that_is_damaged_or_cannot_be_written_is_named(key_file, state_folder, monkeypatch):
    restarted(Autopilot(KEY), key_file)
    (file,) = state_folder.iterdir()
    for content in (b"1 2 3\n", b"a b c d\n", b"\xff"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"signing_\w+, with the time stamps of signed messages, is damaged"):
            connect(Autopilot(KEY), key_file)
    file.unlink()
    state_folder.rmdir()
    state_folder.write_text("no folder")
    with pytest.raises(ValueError, match=r"can't keep the time stamps .* set XDG_STATE_HOME to a folder"):
        connect(Autopilot(KEY), key_file)


def test_systemd_names_the_folder_first(tmp_path, monkeypatch):
    assert state_folder_of_the_node().name == "aero-planner"
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/a:{tmp_path}/b")
    assert state_folder_of_the_node() == tmp_path / "a"
