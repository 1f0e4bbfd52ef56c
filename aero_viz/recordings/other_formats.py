"""Recordings that are not bags: single files of clouds, and captures of sensor packets."""

from __future__ import annotations

from pathlib import Path

from aero_viz.errors import UserError
from aero_viz.recordings.choices import Choices
from aero_viz.recordings.cloud_files import CloudFiles, CloudSequence, PacketClouds
from aero_viz.recordings.cloud_times import FIRST_STAMP
from aero_viz.recordings.imu_messages import ImuRows
from aero_viz.recordings.lvx2 import LVX_MAGIC, find_sensor, lvx2_packets
from aero_viz.recordings.ouster import OusterSensor, ouster_sweeps
from aero_viz.recordings.packets import (
    livox_sweeps,
    packets_of_sensor,
    pcap_kind,
    pcap_livox_packets,
    velodyne_packets,
)
from aero_viz.recordings.pcap import PCAP_MAGICS
from aero_viz.recordings.text_files import is_text_cloud, refuse_poses
from aero_viz.recordings.velodyne import velodyne_sweeps
from aero_viz.scenes.map_files import MAP_SUFFIXES
from aero_viz.scenes.text_cloud import TEXT_SUFFIXES

_MAGICS = {
    b"# .PCD": ".pcd",
    b"#.PCD": ".pcd",
    b"VERSION": ".pcd",
    b"FIELDS": ".pcd",
    b"ply": ".ply",
    b"LASF": ".las",
    b"ASTM-E57": ".e57",
    b"\x93NUMPY": ".npy",
}
_LIVOX = "/livox/lidar"
_ULOG = b"ULog"
_OSF = b"OSF"


def open_capture(path: Path, start: bytes, choices: Choices) -> tuple[str, CloudSequence] | None:
    """Return the format of a capture of packets, and its clouds; None if the file is none.

    Args:
        path: the file.
        start: its first bytes.
        choices: what the user has settled.

    Raises:
        UserError: the file is damaged, or of a format for which the message names the next step.
    """
    if start.startswith(LVX_MAGIC):
        sensor = find_sensor(path, choices.sensor)
        sweeps = livox_sweeps(lvx2_packets(path, sensor))
        return "lvx2", PacketClouds(path, _LIVOX, sweeps, mounting=sensor.mounting, notice=sensor.notice)
    if start.startswith(PCAP_MAGICS):
        kind = pcap_kind(path)
        if kind == "ouster":
            return "ouster-pcap", _ouster_clouds(path, choices, is_osf=False)
        captured = packets_of_sensor(path, kind, choices.sensor)
        if kind == "livox":
            imu = ImuRows("/livox/imu")
            sweeps = livox_sweeps(pcap_livox_packets(captured.datagrams(), imu))
            return "livox-pcap", PacketClouds(path, _LIVOX, sweeps, imu=imu, notice=captured.notice)
        sweeps = velodyne_sweeps(path, velodyne_packets(captured.datagrams()))
        return "velodyne-pcap", PacketClouds(path, "/velodyne_points", sweeps, notice=captured.notice)
    if start.startswith(_ULOG):
        raise UserError(
            f"{path} is a log of PX4, which has no clouds: `aero-viz inspect` checks it, and --poses plays it."
        )
    if start[8:11] == _OSF:
        return "osf", _ouster_clouds(path, choices, is_osf=True)
    return None


def open_cloud(path: Path, start: bytes, choices: Choices) -> tuple[str, CloudSequence] | None:
    """Return the format of a file that holds one cloud, and the cloud; None if the file is none.

    Args:
        path: the file.
        start: its first bytes.
        choices: what the user has settled.

    Raises:
        UserError: the file is damaged, or holds poses.
    """
    suffix = path.suffix.lower()
    found = next((suffix for magic, suffix in _MAGICS.items() if start.startswith(magic)), None)
    is_text = found is None and suffix in TEXT_SUFFIXES
    if is_text:
        refuse_poses(path)
    if found is None and suffix != ".bin" and not (is_text and is_text_cloud(path)):
        return None
    suffix = found if found is not None and (found, suffix) != (".las", ".laz") else suffix
    clouds = CloudFiles(path, [path], [FIRST_STAMP], suffix, columns=choices.columns)
    if path.suffix.lower() in MAP_SUFFIXES:
        clouds.notices.append(f"a single cloud is one sweep; to fly through it as a world: aero-viz demo {path.name}")
    return suffix.lstrip("."), clouds


def _ouster_clouds(path: Path, choices: Choices, *, is_osf: bool) -> PacketClouds:
    imu, sensor = ImuRows("/ouster/imu"), OusterSensor(choices.sensor)
    clouds = PacketClouds(path, "/ouster/points", ouster_sweeps(path, imu, sensor, is_osf=is_osf), imu=imu)
    clouds.mounting = sensor.mounting
    clouds.notices += [sensor.notice] if sensor.notice else []
    return clouds
