"""Files that a user names: only regular ones are opened, by every reader."""

import os
import socket
from pathlib import Path

import pytest

from aero_planner.config.file import load_config
from aero_planner.user_file import open_user_file, read_user_text


@pytest.fixture(params=["pipe", "socket", "device"])
def special(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    """A file that is not regular, and its kind. Reading a pipe that nobody writes to would never return."""
    path = tmp_path / "special"
    if request.param == "pipe":
        os.mkfifo(path)
    elif request.param == "socket":
        socket.socket(socket.AF_UNIX).bind(str(path))
    else:
        path.symlink_to("/dev/zero")
    return path, request.param


def test_a_special_file_is_refused_at_once(special: tuple[Path, str]):
    path, kind = special
    with pytest.raises(OSError, match=f"it is a {kind}, not a regular file"):
        open_user_file(path)
    with pytest.raises(ValueError, match=rf"special can't be read: it is a {kind}, not a regular file"):
        load_config(path)


def test_a_folder_and_a_missing_file_are_refused(tmp_path: Path):
    with pytest.raises(IsADirectoryError):
        open_user_file(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_user_file(tmp_path / "missing")


def test_a_text_is_read_up_to_its_limit(tmp_path: Path):
    path = tmp_path / "a.txt"
    path.write_text("\ufeffabc", encoding="utf-8")
    assert read_user_text(path, limit=6) == "abc"
    path.write_bytes(bytes(3 << 20))
    with pytest.raises(OSError, match="larger than 2 MiB"):
        read_user_text(path, limit=2 << 20)
