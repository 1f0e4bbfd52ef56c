import numpy as np
import pytest

from aero_planner.onboard.mavlink_parser import MavlinkParser
from aero_planner.onboard.mavlink_sender import load_dialect

mavlink = load_dialect()


@pytest.fixture
def sender():
    return mavlink.MAVLink(None, srcSystem=1, srcComponent=1)


def heartbeat(sender, mode: int, *, v1: bool = False) -> bytes:
    return bytes(mavlink.MAVLink_heartbeat_message(2, 12, 81, mode, 4, 3).pack(sender, force_mavlink1=v1))


def modes(messages) -> list[int]:
    return [message.custom_mode for message in messages]


@pytest.mark.parametrize("v1", [False, True])
def test_both_versions_in_a_datagram_and_in_a_stream(sender, v1: bool):
    data = b"".join(heartbeat(sender, k, v1=v1) for k in range(1, 4))
    assert modes(MavlinkParser(mavlink, datagrams=True).parse(data)) == [1, 2, 3]
    stream = MavlinkParser(mavlink, datagrams=False)
    found = [message for k in range(len(data)) for message in stream.parse(data[k : k + 1])]
    assert modes(found) == [1, 2, 3] and stream.bad == 0 and stream.buffered == 0


def test_a_datagram_ends_at_the_first_garbage(sender):
    parser = MavlinkParser(mavlink, datagrams=True)
    good = heartbeat(sender, 1)
    assert modes(parser.parse(good + b"x" + good)) == [1]
    assert parser.bad == 1 and parser.buffered == 0
    assert modes(parser.parse(good + good[:-1])) == [1] and parser.bad == 2


def test_a_stream_finds_messages_between_noise_and_stray_markers(sender):
    parser = MavlinkParser(mavlink, datagrams=False)
    random = np.random.default_rng(0)
    found = []
    for k in range(200):
        noise = random.bytes(int(random.integers(0, 30))) + bytes(random.choice([0xFD, 0xFE, 0], size=3).tolist())
        found += modes(parser.parse(noise + heartbeat(sender, k + 1)))
    found += modes(parser.parse(bytes(600)))
    assert len(found) >= 160 and found == sorted(found)
    assert parser.buffered < 300 and parser.bad > 0


def test_only_wanted_messages_of_wanted_systems_are_decoded(sender):
    other = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
    system_time = bytes(mavlink.MAVLink_system_time_message(1, 2).pack(sender))
    data = heartbeat(sender, 1) + system_time + heartbeat(other, 2) + heartbeat(sender, 3)
    for datagrams in (True, False):
        parser = MavlinkParser(mavlink, datagrams=datagrams, wanted=["HEARTBEAT"], systems=[1])
        assert modes(parser.parse(data)) == [1, 3]
        assert (parser.skipped, parser.bad) == (2, 0)


def test_a_frame_inside_another_one_is_not_a_message(sender):
    """An unknown sender whose messages are forwarded cannot pose as the autopilot."""
    hidden = list(heartbeat(sender, 9)) + [0] * 128
    other = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    tunnel = bytes(mavlink.MAVLink_tunnel_message(0, 0, 0, 60, hidden[:128]).pack(other))
    for datagrams in (True, False):
        parser = MavlinkParser(mavlink, datagrams=datagrams, wanted=["HEARTBEAT"], systems=[1])
        assert modes(parser.parse(tunnel + heartbeat(sender, 1))) == [1]


def test_the_work_for_noise_is_linear(sender, monkeypatch: pytest.MonkeyPatch):
    """Counted in bytes over which a checksum is computed."""
    work = [0]
    checksum = mavlink.x25crc

    def count(data: bytes = b""):
        work[0] += len(data)
        return checksum(data)

    monkeypatch.setattr(mavlink, "x25crc", count)
    random = np.random.default_rng(0)
    worst = (b"\xfd\xff\0\0\0\1\1\0\0\0" * 6600, b"\xfe" * 65_536, random.bytes(65_536), b"\xfe\x09" * 32_768)
    for noise in worst:
        for datagrams in (True, False):
            work[0] = 0
            parser = MavlinkParser(mavlink, datagrams=datagrams)
            for k in range(0, len(noise), 4096):
                parser.parse(noise[k : k + 4096])
            assert work[0] <= 4 * len(noise)
            assert parser.buffered < 300
