"""Files that a user names: only regular ones are opened, by every reader."""

import os
import socket
from pathlib import Path

import pytest

from aero_planner.config.file import load_config
from aero_planner.user_file import (
    open_companion,
    open_user_file,
    parse_json,
    read_user_text,
    restrict_user_files,
    user_folders,
)


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


def test_nothing_outside_of_the_folders_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    inside, outside = tmp_path / "inside", tmp_path / "inside_not"
    for folder in (inside / "deep", outside):
        folder.mkdir(parents=True)
        (folder / "a.txt").write_text("abc")
    (inside / "own.txt").symlink_to("deep/a.txt")
    (inside / "file.txt").symlink_to(outside / "a.txt")
    (inside / "deep" / "folder").symlink_to(outside)
    monkeypatch.chdir(inside)
    restrict_user_files([inside])
    try:
        assert user_folders() == (str(inside.resolve()),)
        for name in ("deep/a.txt", "own.txt", "deep/../own.txt"):
            assert read_user_text(name, limit=9) == "abc"
        for name in ("file.txt", "deep/folder/a.txt", "../inside_not/a.txt", outside / "a.txt", "/etc/passwd"):
            with pytest.raises(FileNotFoundError, match="in the folders that may be read"):
                open_user_file(name)
    finally:
        restrict_user_files(None)
    assert read_user_text("file.txt", limit=9) == "abc"


@pytest.mark.parametrize("name", ["../b.txt", "/etc/passwd", "link.txt", "folder/b.txt", "deep/../../b.txt", "a\0b"])
def test_a_file_names_only_files_of_its_own_folder(tmp_path: Path, name: str):
    home = tmp_path / "home"
    (home / "deep").mkdir(parents=True)
    (tmp_path / "b.txt").write_text("b")
    (home / "link.txt").symlink_to("../b.txt")
    (home / "folder").symlink_to(tmp_path)
    with pytest.raises(PermissionError, match="only files of its own folder are opened"):
        open_companion(home / "a.yaml", name)


def test_a_companion_lies_in_the_folder_or_below_or_beside_what_a_link_leads_to(tmp_path: Path):
    home = tmp_path / "home"
    (home / "deep").mkdir(parents=True)
    (home / "deep" / "b.txt").write_text("b")
    (tmp_path / "a.yaml").symlink_to(home / "a.yaml")
    (tmp_path / "deep").symlink_to(home / "deep")
    for path in (home / "a.yaml", tmp_path / "a.yaml"):
        with open_companion(path, "deep/b.txt") as file:
            assert file.read() == b"b"
    with pytest.raises(FileNotFoundError):
        open_companion(home / "a.yaml", "absent.txt")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[1, " + "9" * 5000 + "]", "a number of 5000 digits"),
        ("[" * 200_000, "nested too deeply"),
        ("{'a'}", "not JSON: .* in line 1, column 2"),
        (b"\xff\xfe\xfa", "not JSON"),
    ],
)
def test_damaged_json_is_described_in_our_words(text: str | bytes, problem: str):
    with pytest.raises(ValueError, match=problem) as caught:
        parse_json(text)
    assert "sys." not in str(caught.value) and "recursion" not in str(caught.value)


def test_json_makes_the_objects_of_the_caller():
    assert parse_json('{"a": 1, "a": 1e3}', list) == [("a", 1), ("a", 1000.0)]
