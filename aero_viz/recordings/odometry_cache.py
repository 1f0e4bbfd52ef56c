"""Estimated motions, kept in the user's cache folder under the hash of the recording."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from aero_planner.output_files import whole_file
from aero_planner.user_file import open_user_file
from aero_viz.recordings.odometry import Motion

_VERSION = 6
"""Changes when the estimate of the same file would change."""
_WHOLE = 64 << 20
"""A file up to this size is hashed as a whole, of a larger one only `_SAMPLES` blocks of `_BLOCK` bytes [bytes]."""
_SAMPLES, _BLOCK = 64, 1 << 20
_FILES = 64
"""Of more files, only about this many are read."""


def cache_folder() -> Path:
    """Return the folder for estimated motions: below XDG_CACHE_HOME, or ~/.cache where that is unset."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "aero-viz" / "odometry"


def motion_key(files: Iterable[Path], *settings: object) -> str:
    """Return the name under which the motion is kept: a hash of the files' contents and of the settings."""
    digest = hashlib.blake2b(repr((_VERSION, settings)).encode(), digest_size=16)
    paths = list(files)
    digest.update(repr([(path.name, path.stat().st_size) for path in paths]).encode())
    for path in paths[:: -(-len(paths) // _FILES) or 1]:
        size = path.stat().st_size
        digest.update(str(size).encode())
        with open_user_file(path) as file:
            if size <= _WHOLE:
                digest.update(file.read())
                continue
            for i in range(_SAMPLES):
                file.seek((size - _BLOCK) * i // (_SAMPLES - 1))
                digest.update(file.read(_BLOCK))
    return digest.hexdigest()


def load_motion(key: str) -> Motion | None:
    """Return the motion that was kept under a name, None if there is none or it cannot be read."""
    try:
        with np.load(cache_folder() / f"{key}.npz", allow_pickle=False) as data:
            arrays = {name: data[name] for name in ("times", "positions", "quaternions")}
            problems = tuple(map(str, data["problems"]))
            numbers = {name: float(data[name]) for name in ("ms_per_sweep", "fitness")}
            return Motion(method=str(data["method"]), problems=problems, **numbers, **arrays)
    except Exception:  # a damaged cache is no reason to fail: the motion is estimated again
        return None


def save_motion(key: str, motion: Motion) -> None:
    """Keep a motion under a name. Does nothing if the folder cannot be written."""
    folder = cache_folder()
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with whole_file(folder / f"{key}.npz") as partial:
            arrays: dict[str, Any] = {**motion._asdict(), "problems": np.array(motion.problems, dtype=str)}
            np.savez_compressed(partial, **arrays)
