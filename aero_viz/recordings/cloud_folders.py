"""Folders of clouds, one file each, with poses and times from the text files next to them."""

from __future__ import annotations

import os
import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from aero_viz.errors import UserError
from aero_viz.recordings.bag_file import list_names
from aero_viz.recordings.choices import AUTOMATIC, Choices
from aero_viz.recordings.cloud_files import CLOUD_SUFFIXES, CloudFiles
from aero_viz.recordings.cloud_times import order_clouds, stamps_in_names
from aero_viz.recordings.text_files import is_text_cloud, refuse_poses
from aero_viz.scenes.text_cloud import TEXT_SUFFIXES

_SUBFOLDERS = ("", "velodyne", "velodyne_points/data", "data", "points", "lidar", "clouds", "scans")
_POSES = ("poses.txt", "pose.txt", "trajectory.txt", "groundtruth.txt", "gt.txt", "tum.txt")
_POSES += ("poses.csv", "global_pose.csv", "registered_poses.csv", "groundtruth.csv", "trajectory.csv", "gt.csv")
_NO_CLOUDS = (*_POSES, "times.txt", "timestamps.txt", "calib.txt")
_DEPTH, _ENTRIES_MAX = 3, 20_000
"""Depth to which clouds are searched for in a folder that holds none, and number of entries that are looked at."""


class CloudFolder(NamedTuple):
    """A folder of clouds."""

    format: str
    clouds: CloudFiles
    pose_file: Path | None


def is_oxts(folder: Path) -> bool:
    """Return True for a folder with the poses of KITTI's raw data, see `aero_viz.recordings.oxts`."""
    return (folder / "data").is_dir() and (folder / "timestamps.txt").is_file()


def open_cloud_folder(path: Path, choices: Choices = AUTOMATIC) -> CloudFolder | None:
    """Return the clouds in a folder, or in the only folder below it that has some; None if it holds no clouds.

    Raises:
        UserError: a file is damaged, the times do not fit the clouds, or several folders below hold clouds.
    """
    for name in _SUBFOLDERS:
        if (path / name).is_dir() and _named_clouds(path / name):
            return _open(path, path / name, choices)
    below = _folders_below(path)
    if len(below) > 1:
        names = list_names([str(folder.relative_to(path)) for folder in below])
        raise UserError(f"{path} is a folder of recordings, not one recording: choose one of {names}.")
    if not below:
        return None
    folder = _open(path, below[0], choices)
    folder.clouds.notices.append(f"the clouds are those in {below[0].relative_to(path)}")
    return folder


def _open(path: Path, folder: Path, choices: Choices) -> CloudFolder:
    """Return the clouds of `folder`, which is `path` or lies below it."""
    named = _named_clouds(folder)
    files = [file for file in named if file.exists()]
    lost = [file.name for file in named if not file.exists()]
    suffix = Counter(file.suffix.lower() for file in files).most_common(1)[0][0]
    files = _without_maps([file for file in files if file.suffix.lower() == suffix])
    is_inner = folder != path or folder.name in {part for known in _SUBFOLDERS for part in known.split("/")}
    places = [folder, folder.parent] if is_inner else [folder]
    places += [place for place in folder.parents if place == path or path in place.parents]
    places = list(dict.fromkeys(places))
    others = sorted(file.name for file in named if file not in files and file.name not in lost)
    files, stamps, notice = order_clouds(files, places)
    clouds = CloudFiles(path, files, stamps, columns=choices.columns)
    clouds.notices += [notice] if notice else []
    if others:
        what = "are of another format or have names unlike those of the others"
        clouds.notices.append(f"clouds that {what} are left out: {list_names(others)}")
    if lost:
        clouds.notices.append(f"links to clouds that do not exist are left out: {list_names(sorted(lost))}")
    return CloudFolder(f"folder of {suffix.lstrip('.')}", clouds, _find_poses(places))


def _find_poses(places: list[Path]) -> Path | None:
    """Return the file of poses next to the clouds, or KITTI's: oxts, or poses/00.txt for sequences/00."""
    found = [place / name for place in places for name in _POSES if (place / name).is_file()]
    found += [file for place in places for file in sorted(place.glob("*.tum"))]
    found += [near / "oxts" for place in places for near in (place, place.parent) if is_oxts(near / "oxts")]
    kitti = [place.parent.parent / "poses" / f"{place.name}.txt" for place in places]
    found += [file for file in kitti if file.exists()]
    return found[0] if found else None


def _named_clouds(folder: Path) -> list[Path]:
    """Return the files in a folder whose names are those of clouds, none if all are links to nothing.

    Texts count only where there are no others: they may be labels, poses or times.
    """
    files = [file for file in folder.iterdir() if not file.is_dir()]
    named = [file for file in files if file.suffix.lower() in CLOUD_SUFFIXES]
    if any(file.exists() for file in named):
        return named
    texts = sorted(file for file in files if file.suffix.lower() in TEXT_SUFFIXES and file.name not in _NO_CLOUDS)
    try:
        for file in texts[:1]:
            refuse_poses(file)
    except UserError:
        return []
    return texts if texts and texts[0].exists() and is_text_cloud(texts[0]) else []


def _folders_below(path: Path) -> list[Path]:
    """Return the folders with clouds that lie below a folder, without following links."""
    found, seen = [], 0
    for root, folders, files in os.walk(path):
        seen += len(folders) + len(files)
        if seen > _ENTRIES_MAX:
            break
        if len(Path(root).relative_to(path).parts) >= _DEPTH:
            folders.clear()
        if Path(root) != path and any(Path(name).suffix.lower() in CLOUD_SUFFIXES for name in files):
            found.append(Path(root))
    return sorted(found)


def _without_maps(files: list[Path]) -> list[Path]:
    """Return the files with a time or, without any times, a number in their names, if these are most; else all."""
    timed = [*stamps_in_names(files)[0]]
    numbered = [file for file in files if re.search(r"\d", file.stem)]
    return next((some for some in (timed, numbered) if len(some) > max(len(files) // 2, 2)), files)
