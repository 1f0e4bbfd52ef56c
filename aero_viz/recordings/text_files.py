"""What a text next to recordings holds: a cloud, or poses."""

from __future__ import annotations

import io
from pathlib import Path

from aero_planner.user_file import open_user_file
from aero_viz.errors import UserError
from aero_viz.recordings.pose_tables import read_pose_text
from aero_viz.scenes.text_cloud import find_text_layout

_HEAD = 1 << 14
"""Bytes in which poses are looked for."""


def is_text_cloud(path: Path) -> bool:
    """Return True for a text of points. A header without coordinates counts, too: reading it says what is wrong."""
    try:
        return find_text_layout(path) is not None
    except ValueError:
        return True


def refuse_poses(path: Path) -> None:
    """Refuse a text of poses, whose rows look like those of points.

    Raises:
        UserError: it holds poses.
    """
    with open_user_file(path) as file:
        head = file.read(_HEAD)
    whole = head if len(head) < _HEAD else head[: head.rfind(b"\n") + 1]
    try:
        table = read_pose_text(path, io.BytesIO(whole))
    except (UserError, ValueError):
        return
    raise UserError(f"{path} holds poses ({table.format}) and no clouds: give it with --poses FILE.")
