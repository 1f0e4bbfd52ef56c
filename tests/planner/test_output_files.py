"""Files that cannot be written are refused before the work, and others are replaced as a whole."""

import os
from pathlib import Path

import pytest

from aero_planner.output_files import check_folder, check_output_files, whole_file


@pytest.fixture
def read_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system that refuses to write, even for the administrator."""
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)


@pytest.mark.usefixtures("read_only")
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("new.mcap", "new.mcap cannot be written: its folder is read-only"),
        ("old.mcap", "old.mcap cannot be written: perm"),
    ],
)
def test_a_missing_permission_is_noticed(tmp_path: Path, name: str, message: str):
    (tmp_path / "old.mcap").write_text("old")
    with pytest.raises(ValueError, match=message):
        check_output_files(tmp_path / name, overwrite=True)


@pytest.mark.usefixtures("read_only")
def test_a_device_in_a_read_only_folder_has_permissions_of_its_own(tmp_path: Path):
    (tmp_path / "device").symlink_to("/dev/null")
    check_folder(tmp_path / "device")


def test_two_outputs_need_two_files(tmp_path: Path):
    with pytest.raises(ValueError, match="cannot hold two outputs"):
        check_output_files(tmp_path / "a", overwrite=False, derived=[tmp_path / "a"])


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path):
    path = tmp_path / "out.txt"
    with whole_file(path) as partial:
        partial.write_text("first")
        assert not path.exists() and partial.suffix == ".txt"
    for error in (KeyboardInterrupt, OSError):
        with pytest.raises(error), whole_file(path) as partial:
            partial.write_text("second")
            raise error
    assert path.read_text() == "first" and os.listdir(tmp_path) == ["out.txt"]
