"""Livox packets over a real socket: hand-written headers, both data types, refusals, sequence and time."""

import socket
import struct
import zlib

import numpy as np
import pytest

from aero_planner.onboard import livox
from aero_planner.onboard.livox import (
    CARTESIAN_CM,
    CARTESIAN_MM,
    LivoxPacket,
    LivoxSource,
    Reject,
    decode_points,
    encode_packet,
    parse_packet,
)


def by_hand(points_mm, tags, *, stamp=7_000_000_000, interval=4750, sequence=17, data_type=1):
    """Return a packet written from the vendor's table of offsets, without the code under test."""
    body = b"".join(
        struct.pack("<iiiBB" if data_type == 1 else "<hhhBB", *point, 90, tag)
        for point, tag in zip(points_mm, tags, strict=True)
    )
    packet = bytearray(36) + body
    packet[1:3] = struct.pack("<H", len(packet))
    packet[3:5] = struct.pack("<H", interval)
    packet[5:7] = struct.pack("<H", len(tags))
    packet[7:9] = struct.pack("<H", sequence)
    packet[10] = data_type
    packet[28:36] = struct.pack("<Q", stamp)
    packet[24:28] = struct.pack("<I", zlib.crc32(packet[28:]))
    return bytes(packet)


@pytest.fixture
def source(clock):
    source = LivoxSource(0, host="127.0.0.1", clock=clock)
    yield source
    source.close()


@pytest.fixture
def send(source):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        yield lambda data: sensor.sendto(data, ("127.0.0.1", source.port))


def test_a_packet_by_hand():
    packet = parse_packet(by_hand([(1234, -5, 70000), (-1, 0, 2)], [0, 0]))
    assert isinstance(packet, LivoxPacket)
    assert (packet.stamp_ns, packet.count, packet.sequence, packet.time_type) == (7_000_000_000, 2, 17, 0)
    assert packet.interval == pytest.approx(475e-6)
    points, tags = decode_points(CARTESIAN_MM, packet.payload)
    np.testing.assert_allclose(points, [[1.234, -0.005, 70.0], [-0.001, 0.0, 0.002]], rtol=1e-6)
    assert tags.tolist() == [0, 0]


def test_a_centimetre_packet_by_hand():
    packet = parse_packet(by_hand([(123, -4, 32767)], [3], data_type=2))
    assert isinstance(packet, LivoxPacket)
    points, tags = decode_points(CARTESIAN_CM, packet.payload)
    np.testing.assert_allclose(points, [[1.23, -0.04, 327.67]], rtol=1e-6)
    assert tags.tolist() == [3]


@pytest.mark.parametrize(("data_type", "unit"), [(CARTESIAN_MM, 1e-3), (CARTESIAN_CM, 1e-2)])
def test_encoded_packets_parse_to_the_same_points(data_type, unit):
    points = np.random.default_rng(0).uniform(-40.0, 40.0, size=(96, 3))
    data = encode_packet(points, stamp_ns=2**63, interval=475e-6, sequence=65536 + 5, data_type=data_type)
    assert len(data) == 36 + 96 * (14 if data_type == CARTESIAN_MM else 8)
    packet = parse_packet(data)
    assert isinstance(packet, LivoxPacket)
    assert (packet.stamp_ns, packet.sequence, packet.count) == (2**63, 5, 96)
    np.testing.assert_allclose(decode_points(data_type, packet.payload)[0], points, atol=0.51 * unit)


def test_an_encoded_packet_equals_one_by_hand():
    hand = bytearray(by_hand([(1234, -5, 70000)], [2]))
    made = encode_packet([[1.234, -0.005, 70.0]], stamp_ns=7_000_000_000, interval=475e-6, sequence=17, tags=2)
    hand[36 + 12] = 0  # reflectivity, which is not simulated
    hand[24:28] = struct.pack("<I", zlib.crc32(hand[28:]))
    assert made == bytes(hand)


def changed(position, value, *, seal=False):
    packet = bytearray(by_hand([(1000, 0, 0)] * 3, [0] * 3))
    packet[position] = value
    if seal:
        packet[24:28] = struct.pack("<I", zlib.crc32(packet[28:]))
    return bytes(packet)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", Reject.SHORT),
        (by_hand([], [])[:35], Reject.SHORT),
        (changed(0, 5), Reject.VERSION),
        (changed(10, 0), Reject.TYPE),
        (changed(10, 3), Reject.TYPE),
        (changed(10, 2), Reject.LENGTH),
        (changed(1, 0), Reject.LENGTH),
        (changed(5, 4), Reject.LENGTH),
        (changed(5, 2), Reject.LENGTH),
        (by_hand([], []), Reject.LENGTH),
        (by_hand([(1, 2, 3)], [0])[:-1], Reject.LENGTH),
        (by_hand([(1, 2, 3)], [0]) + b"\0", Reject.LENGTH),
        (changed(40, 77), Reject.CHECKSUM),
        (changed(28, 77), Reject.CHECKSUM),
        (changed(24, 77), Reject.CHECKSUM),
    ],
)
def test_datagrams_that_are_not_packets_are_refused(data, reason):
    assert parse_packet(data) is reason


def test_changes_to_reserved_bytes_are_allowed():
    assert isinstance(parse_packet(changed(15, 200)), LivoxPacket)


def test_points_get_host_times_from_the_sensors_clock(source, clock, send):
    arrivals = [100.0055, 100.0151, 100.0257]  # 0.5, 0.1 and 0.7 ms after the last point
    packets = []
    for k, arrival in enumerate(arrivals):
        send(by_hand([(1000, 0, 0)] * 96, [0] * 96, stamp=10_000_000 * k, interval=50_000, sequence=k))
        clock.now = arrival
        packets += source.poll()
        assert len(packets) == k + 1
        assert packets[k].points.shape == (96, 3)
        assert packets[k].times.shape == (96,)
    # The offset includes the smallest delay of 0.1 ms, by which the mapped times are late.
    times = packets[-1].times
    np.testing.assert_allclose(times, 100.0151 - 0.005 + 0.01 + np.arange(96) / 95 * 0.005, atol=1e-6)
    assert times[-1] <= clock.now


def test_rays_without_return_and_noise_are_removed(source, clock, send):
    tags = [0, 0b01, 0b10, 0b0100, 0b1000, 0b010000, 0b100000, 0b11000000, 0]
    points = [(1000 + i, 0, 0) for i in range(8)] + [(0, 0, 0)]
    send(by_hand(points, tags))
    (packet,) = source.poll()
    np.testing.assert_allclose(packet.points[:, 0], [1.0, 1.001, 1.003, 1.005, 1.007], rtol=1e-6)
    assert (source.counters.points, source.counters.filtered) == (5, 4)


def test_uncertain_points_can_be_removed(clock):
    source = LivoxSource(0, host="127.0.0.1", keep_uncertain=False, clock=clock)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        sensor.sendto(by_hand([(1000, 0, 0)] * 3, [0, 0b01, 0b010000]), ("127.0.0.1", source.port))
    (packet,) = source.poll()
    source.close()
    assert len(packet.points) == 1


def sequence_of(source, send, numbers):
    for number in numbers:
        send(by_hand([(1000, 0, 0)], [0], sequence=number, stamp=10**9 + 1000 * (number % 50000), interval=0))
        source.poll()
    return source.counters


@pytest.mark.parametrize(
    ("numbers", "packets", "lost", "duplicates"),
    [
        ([5, 6, 7], 3, 0, 0),
        ([5, 8], 2, 2, 0),
        ([65534, 65535, 0, 1], 4, 0, 0),  # shipped firmware counts through 16 bits
        ([65534, 2], 2, 3, 0),
        ([205, 206, 207, 0, 1, 2], 6, 0, 0),  # as documented: reset at each frame
        ([5, 7, 6, 8], 4, 0, 0),  # out of order, not lost
        ([5, 6, 6, 7, 5], 3, 0, 2),
        ([5, 9, 7, 7, 6, 8], 5, 0, 1),
        ([100, 99, 101], 3, 0, 0),  # a late packet from before the first
        ([5, 5000], 2, 0, 0),  # a reset, too large for a loss
    ],
)
def test_losses_and_duplicates_are_counted(source, send, numbers, packets, lost, duplicates):
    counters = sequence_of(source, send, numbers)
    assert (counters.packets, counters.lost, counters.duplicates, counters.bad) == (packets, lost, duplicates, 0)


def test_bad_datagrams_are_counted_and_do_no_harm(source, send):
    send(b"nonsense")
    send(changed(40, 77))
    send(changed(10, 0))
    send(by_hand([(2000, 0, 0)], [0]))
    (packet,) = source.poll()
    assert packet.points.tolist() == [[2.0, 0.0, 0.0]]
    assert source.counters.bad == 3
    counts = {Reject.SHORT: 1, Reject.CHECKSUM: 1, Reject.TYPE: 1}
    assert {reason: count for reason, count in source.rejects.items() if count} == counts


def test_data_types_may_alternate(source, send):
    for k in range(4):
        send(by_hand([(1000, 0, 0)], [0], sequence=k, stamp=10**9 + 1000 * k, data_type=1 + k % 2))
    assert [packet.points[0, 0] for packet in source.poll()] == pytest.approx([1.0, 10.0, 1.0, 10.0])
    assert source.counters.lost == 0


def test_with_an_address_only_the_sensor_is_heard():
    source = LivoxSource(0, host="127.0.0.1", sensor="127.0.0.2")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(by_hand([(1000, 0, 0)], [0]), ("127.0.0.1", source.port))
    assert source.poll() == []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        sensor.bind(("127.0.0.2", 0))
        sensor.sendto(by_hand([(1000, 0, 0)], [0]), ("127.0.0.1", source.port))
    assert len(source.poll()) == 1
    source.close()


def test_a_flood_from_unknown_senders_leaves_room_for_the_sensor(caplog):
    source = LivoxSource(0, host="127.0.0.1", sensor="127.0.0.2")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor,
    ):
        sensor.bind(("127.0.0.2", 0))
        for k in range(20_000):
            stranger.sendto(by_hand([(1000, 0, 0)], [0]), ("127.0.0.1", source.port))
            if k == 100:
                assert source.poll() == []
        sensor.sendto(by_hand([(2000, 0, 0)], [0]), ("127.0.0.1", source.port))
        (packet,) = source.poll()
    assert packet.points.tolist() == [[2.0, 0.0, 0.0]]
    assert source.dropped_datagrams == 20_000 and source.counters.bad == 0
    assert caplog.text.count("are ignored: the LiDAR is at 127.0.0.2") == 1
    source.close()


def test_a_port_in_use_is_an_error(source):
    with pytest.raises(OSError, match="in use"):
        LivoxSource(source.port, host="127.0.0.1")


def test_one_poll_is_bounded(source, send, monkeypatch):
    monkeypatch.setattr(livox, "_PACKETS_PER_POLL", 30)
    for k in range(100):
        send(by_hand([(1000, 0, 0)], [0], sequence=k, stamp=480_000 * k))
    taken = [sum(len(packet.points) for packet in source.poll()) for _ in range(5)]
    assert taken == [30, 30, 30, 10, 0]
