"""Small captures of sensor packets, scans, clouds and logs of PX4, for the tests of recordings."""

import importlib
import socket
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bags
import dpkt
import laspy
import numpy as np
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr
from laspy.vlrs.vlrlist import VLRList

from aero_planner.onboard.livox import encode_packet

WALL = bags.wall(500)


def write_pcap(path: Path, datagrams: list[tuple[float, int, bytes]]) -> Path:
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=1 << 16)
        for time, port, payload in datagrams:
            udp = dpkt.udp.UDP(sport=port, dport=port, data=payload, ulen=8 + len(payload))
            ip = dpkt.ip.IP(src=b"\x7f\0\0\1", dst=b"\x7f\0\0\1", p=17, data=udp, len=28 + len(payload))
            writer.writepkt(bytes(dpkt.ethernet.Ethernet(data=ip)), ts=time)
    return path


def write_frames(
    path: Path, frames: list[tuple[float, str, bytes]], *, link: str = "ethernet", ng: bool = False
) -> Path:
    """Write the packets of UDP that hosts send to port 56301 or 2368 [s, address and port, payload] over a link."""
    packets = []
    for time, name, payload in frames:
        address, _, port = name.partition("/")
        size = struct.pack(">HHHH", 40000, int(port), 8 + len(payload), 0) + payload
        if ":" in address:
            ip = b"\x60\0\0\0" + struct.pack(">HBB", len(size), 17, 64)
            ip += socket.inet_pton(socket.AF_INET6, address) + bytes(16) + size
        else:
            ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(size), 0, 0, 64, 17, 0)
            ip += socket.inet_aton(address) + bytes(4) + size
        kind = b"\x86\xdd" if ":" in address else b"\x08\0"
        header = {
            "ethernet": bytes(12) + kind,
            "vlan": bytes(12) + b"\x81\0\0\5" + kind,
            "two vlans": bytes(12) + b"\x88\xa8\0\5\x81\0\0\6" + kind,
            "cooked": bytes(14) + kind,
            "cooked 2": kind + bytes(18),
            "loopback": struct.pack("<I", 2),
        }.get(link, b"")
        packets.append((time, header + ip))
    number = {"cooked": 113, "cooked 2": 276, "loopback": 0, "raw": 101, "raw of BSD": 12, "IP": 228}.get(link, 1)
    if not ng:
        data = b"\xd4\xc3\xb2\xa1" + struct.pack("<2H4I", 2, 4, 0, 0, 1 << 16, number)
        for time, frame in packets:
            data += struct.pack("<4I", int(time), round(1e6 * (time % 1)), len(frame), len(frame)) + frame
        path.write_bytes(data)
        return path

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        return struct.pack("<2I", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    data = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    data += block(1, struct.pack("<HHI", number, 0, 1 << 16) + struct.pack("<HHB3xI", 9, 1, 9, 0))
    data += block(5, bytes(12))
    for time, frame in packets:
        stamp = round(1e9 * time)
        data += block(6, struct.pack("<5I", 0, stamp >> 32, stamp & 0xFFFFFFFF, len(frame), len(frame)) + frame)
    path.write_bytes(data)
    return path


def livox_packets(sweeps: int) -> list[tuple[int, np.ndarray]]:
    """Return stamps [ns] and points of packets of 50 points, 5 ms apart."""
    return [(1_700_000_000_000_000_000 + 5_000_000 * i, WALL[:50] + 0.001 * i) for i in range(20 * sweeps)]


def write_lvx2(
    path: Path,
    packets: list[tuple[int, np.ndarray]],
    *,
    poses: dict[int, tuple[float, ...] | None] | None = None,
    sensors: list[int] | None = None,
) -> Path:
    """Write the layout of Livox's "LVX2 Specifications": headers, devices, frames of ten packages.

    Args:
        path: the file.
        packets: stamps [ns] and points.
        poses: by the number of a sensor, roll, pitch, yaw [deg], x, y, z [m]; None for one that does not count.
        sensors: numbers of the sensors of the packets; None is 7 for all.
    """
    data = bytearray(b"livox_tech".ljust(16, b"\0") + bytes([2, 0, 0, 0]) + struct.pack("<I", 0xAC0EA767))
    devices = [
        struct.pack("<16s16sIBBB6f", b"SN%d" % number, b"", number, 0, 9, pose is not None, *(pose or (9.0,) * 6))
        for number, pose in (poses or {7: None}).items()
    ]
    data += struct.pack("<IB", 50, len(devices)) + b"".join(devices)
    for first in range(0, len(packets), 10):
        frame = bytearray()
        for i, (stamp, points) in enumerate(packets[first : first + 10]):
            payload = b"".join(struct.pack("<iiiBB", *map(int, np.rint(1000.0 * point)), 9, 0) for point in points)
            number = 7 if sensors is None else sensors[first + i]
            frame += struct.pack("<BIBBQHBIB4x", 0, number, 9, 0, stamp, i, 1, len(payload), 0) + payload
        here = len(data)
        data += struct.pack("<3Q", here, here + 24 + len(frame), first // 10) + frame
    path.write_bytes(data)
    return path


def velodyne_packet(azimuth: int, microseconds: int, distance: float) -> bytes:
    """Return a packet of a VLP-16: twelve blocks of 2 x 16 channels, 0.4 deg apart."""
    blocks = b""
    for block in range(12):
        channel = struct.pack("<HB", round(distance / 0.002), 10)
        blocks += struct.pack("<HH", 0xEEFF, (azimuth + 40 * block) % 36000) + 32 * channel
    return blocks + struct.pack("<IBB", microseconds, 0x37, 0x22)


def laser_scan(seconds: float) -> bags.Item:
    """Return a scan of a circle of 3 m, of which every tenth range is out of its limits."""
    stamp = bags.START + round(seconds * 1e9)
    ranges = np.full(90, 3.0, np.float32)
    ranges[::10] = np.inf

    def build(store, ros1):
        return bags.make(
            store, "sensor_msgs/msg/LaserScan", header=bags.header(store, ros1, stamp, "laser"), angle_min=-1.0,
            angle_max=1.0, angle_increment=2.0 / 89, time_increment=1e-3, scan_time=0.1, range_min=0.1, range_max=10.0,
            ranges=ranges, intensities=np.zeros(0, np.float32),
        )  # fmt: skip

    return bags.Item("/scan", "sensor_msgs/msg/LaserScan", stamp, build)


def write_ulog(
    path: Path, rows: int, *, utc: float | None, parameters: dict[str, float] | None = None, hover: float = 0.0
) -> Path:
    """Write a ULog: north at 2 m/s at a height of 3 m, heading east, 50 Hz, with parameters and hover thrust."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<H", len(body)) + kind + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    data += message(b"B", bytes(40))
    formats = [
        b"vehicle_local_position:uint64_t timestamp;float x;float y;float z;float vx;float vy;float vz;",
        b"vehicle_attitude:uint64_t timestamp;float[4] q;",
        b"sensor_gps:uint64_t timestamp;uint64_t time_utc_usec;",
        b"hover_thrust_estimate:uint64_t timestamp;float hover_thrust;",
    ]
    data += b"".join(message(b"F", text) for text in formats)
    for name, value in (parameters or {}).items():
        key = f"float {name}".encode()
        data += message(b"P", struct.pack("<B", len(key)) + key + struct.pack("<f", value))
    for number, name in enumerate(text.split(b":")[0] for text in formats):
        data += message(b"A", struct.pack("<BH", 0, number) + name)
    half = np.sqrt(0.5)
    for i in range(rows):
        time = 5_000_000 + 20_000 * i
        place = struct.pack("<HQ6f", 0, time, 0.04 * i, 0.0, -3.0, 2.0, 0.0, 0.0)
        data += message(b"D", struct.pack("<HQ4f", 1, time, half, 0.0, 0.0, half)) + message(b"D", place)
        if hover:
            data += message(b"D", struct.pack("<HQf", 3, time, hover))
        if utc is not None:
            data += message(b"D", struct.pack("<HQQ", 2, time, round(1e6 * (utc + 1e-6 * time))))
    path.write_bytes(data)
    return path


def livox_imu_packet(
    stamp: int, rates: Sequence[float] = (0.1, 0.2, 0.3), forces: Sequence[float] = (0.0, 0.0, 1.0)
) -> bytes:
    """Return a packet of the IMU as in Livox's protocol, with angular velocities [rad/s] and specific forces [g]."""
    checked = struct.pack("<Q6f", stamp, *rates, *forces)
    return struct.pack("<BHHHHBBB12xI", 0, 60, 0, 1, 0, 0, 0, 0, zlib.crc32(checked)) + checked


def write_mid360(path: Path) -> Path:
    """Write a capture of three sweeps of a Mid-360, with its IMU at 200 Hz."""
    datagrams = [(0.0, 56401, b"imu"), (0.0, 53, b"")]
    for i, (stamp, points) in enumerate(livox_packets(3)):
        packet = encode_packet(points, stamp_ns=stamp, interval=245e-6, sequence=i)
        datagrams += [(stamp * 1e-9, 56301, packet), (stamp * 1e-9, 56401, livox_imu_packet(stamp))]
    return write_pcap(path, datagrams)


def write_vlp16(path: Path) -> Path:
    """Write a capture of three turns of a VLP-16."""
    datagrams = []
    for i in range(3 * 75 + 10):
        time = 1327e-6 * i
        datagrams.append((1_700_000_000.0 + time, 2368, velodyne_packet(480 * i, round(1e6 * time), 8.0)))
    return write_pcap(path, datagrams)


def write_las(
    path: Path,
    points: np.ndarray,
    *,
    keys: dict[int, int] | None = None,
    wkt: str | None = None,
    extended: bool = False,
) -> None:
    """Write a LAS or LAZ file.

    Args:
        path: the file.
        points: [n, 3].
        keys: GeoTIFF keys and their values.
        wkt: text of the coordinate system.
        extended: True for LAS 1.4 with the text at the end of the file.
    """
    header = laspy.LasHeader(point_format=6 if extended else 3, version="1.4" if extended else "1.2")
    header.scales, header.offsets = np.full(3, 1e-4), points.min(axis=0)
    if wkt is not None:
        record = WktCoordinateSystemVlr(wkt)
        if extended:
            header.evlrs = VLRList([record])
        else:
            header.vlrs.append(record)
    if keys is not None:
        directory = GeoKeyDirectoryVlr()
        directory.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in keys.items()]
        directory.geo_keys_header.number_of_keys = len(keys)
        header.vlrs.append(directory)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))


def write_two_ousters(path: Path) -> None:
    """Write an OSF of three sweeps of two sensors: 11 with ranges of 5 m, and 22 with 8 m, mounted upside down."""
    core: Any = importlib.import_module("ouster.sdk.core")
    osf: Any = importlib.import_module("ouster.sdk.osf")
    infos = [core.SensorInfo.from_default(core.LidarMode._512x10) for _ in range(2)]
    infos[0].sn, infos[1].sn = 11, 22
    infos[1].sensor_to_body = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])
    writer = osf.Writer(str(path), infos)
    for k in range(3):
        for number, info in enumerate(infos):
            frame, start = core.LidarFrame(info), bags.START + 100_000_000 * k + 1000 * number
            frame.field("RANGE")[:] = 5000 + 3000 * number
            frame.frame_id, frame.status[:], frame.measurement_id[:] = k + 1, 1, np.arange(512)
            frame.timestamp[:] = start + 190_000 * np.arange(512)
            writer.save(number, frame)
    writer.close()


def write_ouster(path: Path) -> None:
    """Write three sweeps of an OS-1-64 and its IMU: PATH.pcap with PATH.json, and the same sweeps as PATH.osf.

    All ranges of sweep k are 5 + 0.1 k [m], except those of the first column, which has no returns.
    """
    core: Any = importlib.import_module("ouster.sdk.core")
    osf: Any = importlib.import_module("ouster.sdk.osf")
    info = core.SensorInfo.from_default(core.LidarMode._512x10)
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503
    form = core.PacketFormat(info)
    writer = osf.Writer(str(path.with_suffix(".osf")), info)
    datagrams = []
    for k in range(3):
        frame, start = core.LidarFrame(info), bags.START + 100_000_000 * k
        frame.field("RANGE")[:, 1:] = 5000 + 100 * k
        frame.frame_id, frame.status[:], frame.measurement_id[:] = k + 1, 1, np.arange(512)
        frame.timestamp[:] = start + 190_000 * np.arange(512)
        writer.save(0, frame)
        imu = struct.pack("<3Q6f", 0, start, start, 0.0, 0.0, 1.0, 10.0, 0.0, 0.0)  # [g], [deg/s]
        datagrams.append((1e-9 * start, 7503, imu))
        datagrams += [(1e-9 * start, 7502, bytes(packet.buf)) for packet in core.frame_to_packets(frame, form, 0, 0)]
    writer.close()
    write_pcap(path.with_suffix(".pcap"), datagrams)
    path.with_suffix(".json").write_text(info.to_json_string())
