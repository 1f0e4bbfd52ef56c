"""Recordings that are not bags: folders and single files of clouds, and captures of sensor packets."""

from __future__ import annotations

import re
from collections import Counter
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aero_planner.user_file import read_user_text
from aero_viz.errors import UserError
from aero_viz.input_limits import TEXT_MAX
from aero_viz.recordings.bag_file import list_names, one_line
from aero_viz.recordings.choices import AUTOMATIC, Choices
from aero_viz.recordings.cloud_files import CLOUD_SUFFIXES, STAMP_END, CloudFiles, CloudSequence, PacketClouds
from aero_viz.recordings.imu_messages import ImuRows
from aero_viz.recordings.ouster import ouster_sweeps
from aero_viz.recordings.packets import (
    LVX_MAGIC,
    livox_sweeps,
    lvx2_packets,
    pcap_kind,
    pcap_livox_packets,
    velodyne_sweeps,
)
from aero_viz.recordings.pcap import PCAP_MAGICS
from aero_viz.scenes.map_files import MAP_SUFFIXES

_PERIOD = 100_000_000
FIRST_STAMP = 1_000_000_000
"""Stamp of the first cloud where none is known [ns]; zero would mean that it is unset. Times that are not since 1970
are counted from it."""
SINCE_1970 = 10**17
"""Smallest stamp that is a time since 1970 [ns]."""
_MAGICS = {
    b"# .PCD": ".pcd",
    b"#.PCD": ".pcd",
    b"VERSION": ".pcd",
    b"FIELDS": ".pcd",
    b"ply": ".ply",
    b"LASF": ".las",
    b"\x93NUMPY": ".npy",
}
_DATE = re.compile(r"\d{4}-\d\d-\d\d ")
"""Start of a date and a time of day (UTC), as in KITTI's raw data."""
_PCAPNG = b"\x0a\x0d\x0d\x0a"
_ULOG = b"ULog"
_OSF = b"OSF"
_SUBFOLDERS = ("", "velodyne", "velodyne_points/data", "data", "points", "lidar", "clouds", "scans")
_POSES = ("poses.txt", "pose.txt", "trajectory.txt", "groundtruth.txt", "gt.txt", "tum.txt")
_TIMES = ("times.txt", "timestamps.txt")
_TIME_IN_NAME = re.compile(r"(?:^|\D)(\d{9,19})(?:\.(\d{1,9})|_(\d{9}))?(?:\.pcd)?$")
"""A time since 1970 at the end of a name: one number, or seconds with decimals or "_" and nine digits."""
_UNITS = ((1e17, 1.0), (1e14, 1e3), (1e11, 1e6), (1e8, 1e9))
"""Smallest number that is a time since 1970 in ns, us, ms, s, and the length of its unit [ns]."""


def is_oxts(folder: Path) -> bool:
    """Return True for a folder with the poses of KITTI's raw data, see `aero_viz.recordings.oxts`."""
    return (folder / "data").is_dir() and (folder / "timestamps.txt").is_file()


class CloudFolder(NamedTuple):
    """A folder of clouds."""

    format: str
    clouds: CloudFiles
    pose_file: Path | None


def open_other_file(path: Path, start: bytes, choices: Choices = AUTOMATIC) -> tuple[str, CloudSequence] | None:
    """Return the format of a file that is not a bag, and its clouds; None if the format is unknown.

    Args:
        path: the file.
        start: its first bytes.
        choices: what the user has settled.

    Raises:
        UserError: the file is damaged, or of a format for which the message names the next step.
    """
    suffix = path.suffix.lower()
    if start.startswith(LVX_MAGIC):
        return "lvx2", PacketClouds(path, "/livox/lidar", livox_sweeps(lvx2_packets(path)))
    if start.startswith(PCAP_MAGICS):
        kind = pcap_kind(path)
        if kind == "ouster":
            return "ouster-pcap", _ouster_clouds(path, is_osf=False)
        if kind == "livox":
            imu = ImuRows("/livox/imu")
            sweeps = livox_sweeps(pcap_livox_packets(path, imu))
            return "livox-pcap", PacketClouds(path, "/livox/lidar", sweeps, imu=imu)
        return "velodyne-pcap", PacketClouds(path, "/velodyne_points", velodyne_sweeps(path))
    if start.startswith(_PCAPNG):
        raise UserError(f"{path} is a pcapng capture: convert it with `editcap -F pcap {path.name} OUT.pcap`.")
    if start.startswith(_ULOG):
        raise UserError(
            f"{path} is a log of PX4, which has no clouds: `aero-viz inspect` checks it, and --poses plays it."
        )
    if start[8:11] == _OSF:
        return "osf", _ouster_clouds(path, is_osf=True)
    found = next((suffix for magic, suffix in _MAGICS.items() if start.startswith(magic)), None)
    if found is None and suffix not in (".bin", ".xyz", ".pts"):
        return None
    suffix = found if found is not None and (found, suffix) != (".las", ".laz") else suffix
    clouds = CloudFiles(path, [path], [FIRST_STAMP], suffix, columns=choices.columns)
    if path.suffix.lower() in MAP_SUFFIXES:
        clouds.notices.append(f"a single cloud is one sweep; to fly through it as a world: aero-viz demo {path.name}")
    return suffix.lstrip("."), clouds


def _ouster_clouds(path: Path, *, is_osf: bool) -> PacketClouds:
    imu = ImuRows("/ouster/imu")
    return PacketClouds(path, "/ouster/points", ouster_sweeps(path, imu, is_osf=is_osf), imu=imu)


def open_cloud_folder(path: Path, choices: Choices = AUTOMATIC) -> CloudFolder | None:
    """Return the clouds in a folder, with poses and times from the text files next to them; None if it holds no clouds.

    Raises:
        UserError: a file is damaged, or the times do not fit the clouds.
    """
    for name in _SUBFOLDERS:
        folder = path / name
        if not folder.is_dir():
            continue
        named = [file for file in folder.iterdir() if file.suffix.lower() in CLOUD_SUFFIXES]
        files = [file for file in named if file.exists() and not file.is_dir()]
        lost = [file.name for file in named if not file.exists()]
        if not files:
            continue
        suffix = Counter(file.suffix.lower() for file in files).most_common(1)[0][0]
        files = [file for file in files if file.suffix.lower() == suffix]
        inner = name or folder.name in {part for known in _SUBFOLDERS for part in known.split("/")}
        places = list(dict.fromkeys([folder, folder.parent, path] if inner else [folder]))
        files = _without_maps(files)
        others = sorted(file.name for file in named if file not in files and file.name not in lost)
        files, stamps, notice = _in_order(files, places)
        clouds = CloudFiles(path, files, stamps, columns=choices.columns)
        clouds.notices += [notice] if notice else []
        if others:
            what = "are of another format or have names unlike those of the others"
            clouds.notices.append(f"clouds that {what} are left out: {list_names(others)}")
        if lost:
            clouds.notices.append(f"links to clouds that do not exist are left out: {list_names(sorted(lost))}")
        pose_file = next((place / pose for place in places for pose in _POSES if (place / pose).is_file()), None)
        pose_file = pose_file or next((file for place in places for file in sorted(place.glob("*.tum"))), None)
        if pose_file is None:  # KITTI's raw data, or its odometry: poses/00.txt for sequences/00
            kitti = [near / "oxts" for place in places for near in (place, place.parent) if is_oxts(near / "oxts")]
            kitti += [place.parent.parent / "poses" / f"{place.name}.txt" for place in places]
            pose_file = next((file for file in kitti if file.exists()), None)
        return CloudFolder(f"folder of {suffix.lstrip('.')}", clouds, pose_file)
    return None


def _without_maps(files: list[Path]) -> list[Path]:
    """Return the files with a time or, without any times, a number in their names, if these are most; else all."""
    timed = [file for file in files if _time_in_name(file) is not None]
    numbered = [file for file in files if re.search(r"\d", file.stem)]
    return next((some for some in (timed, numbered) if len(some) > max(len(files) // 2, 2)), files)


def _in_order(files: list[Path], places: list[Path]) -> tuple[list[Path], list[int], str]:
    """Return the files in the order of time, their stamps [ns], and a notice on where these are from.

    Args:
        files: clouds.
        places: folders in which there may be a text with the times of the sorted files.
    """
    files = sorted(files, key=_natural)
    text = next((place / name for place in places for name in _TIMES if (place / name).is_file()), None)
    if text is not None:
        return files, read_stamps(text, files), ""
    named = sorted((stamp, file) for file in files if (stamp := _time_in_name(file)) is not None)
    if len(named) == len(files):
        return [file for _, file in named], [stamp for stamp, _ in named], ""
    notice = "no times are recorded: the clouds are assumed to be 0.1 s apart" if len(files) > 1 else ""
    return files, [FIRST_STAMP + _PERIOD * i for i in range(len(files))], notice


def _natural(file: Path) -> tuple[tuple[str, float], ...]:
    """Return a key that sorts numbers in names by their values: 9 before 10, and 0.9 before 1.0."""
    try:
        return (("", float(file.stem)),)
    except ValueError:
        return tuple((text, float(number or 0)) for text, number in re.findall(r"(\D*)(\d{0,300})", file.stem))


def _time_in_name(file: Path) -> int | None:
    """Return the time since 1970 in a name [ns], None if there is none."""
    found = _TIME_IN_NAME.search(file.stem)
    if found is None:
        return None
    whole, decimals, nanoseconds = found.groups()
    unit = next((length for least, length in _UNITS if int(whole) >= least), None)
    if unit is None or ((decimals or nanoseconds) and unit != 1e9):
        return None
    stamp = int(whole) * int(unit) + int(nanoseconds or (decimals or "").ljust(9, "0"))
    return stamp if stamp < STAMP_END else None


def read_stamps(path: Path, files: list[Path]) -> list[int]:
    """Return the times in a text [ns], one per file; where files are missing, their names are numbers of lines.

    Raises:
        UserError: the text cannot be read, or does not fit the files.
    """
    try:
        text = read_user_text(path, limit=TEXT_MAX)
        values = _times_in(text)
        if not np.isfinite(values).all():
            raise ValueError("one of them is not finite")
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror or error}.") from error
    except ValueError as error:
        problem = one_line(error)[:200]
        raise UserError(f"{path} must hold one time or date per line ({problem}); correct or remove it.") from error
    if len(values) != len(files):
        lines = [int(file.stem) if file.stem.isdecimal() else len(values) for file in files]
        if max(lines) >= len(values):
            raise UserError(f"{path} holds {len(values)} times for {len(files)} clouds; correct or remove it.")
        values = [values[line] for line in lines]
    unit = next((length for least, length in _UNITS if values[0] >= least), 1e9)
    first = 0 if values[0] >= _UNITS[-1][0] else FIRST_STAMP
    if max(values) * unit >= STAMP_END - first:
        raise UserError(f"{path} holds a time that is beyond 2038; correct or remove it.")
    return [max(round(value * unit), 0) + first for value in values]


def _times_in(text: str) -> list[float]:
    """Return the times in the lines of a text: dates, or a column of numbers next to which others may have names.

    Comments and a header are skipped. A column that only counts the lines is no time unless it is the only one.

    Raises:
        ValueError: a line is none of these.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip() and line.strip()[0] not in "#%"]
    if lines and _DATE.match(lines[0]):
        return [datetime.fromisoformat(line[:26]).replace(tzinfo=timezone.utc).timestamp() for line in lines]
    rows = [re.split(r"[,;\s]+", line) for line in lines]
    if len(rows) > 1 and not any(map(_is_number, rows[0])) and any(map(_is_number, rows[1])):
        del rows[0]
    columns = [column for column in zip(*rows, strict=False) if any(map(_is_number, column))] or [
        [row[0] for row in rows]
    ]
    numbers = [list(map(float, column)) for column in columns]
    counts = [[first + i for i in range(len(rows))] for first in (0, 1)]
    return next((column for column in numbers if column not in counts), numbers[0])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
