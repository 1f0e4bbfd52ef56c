"""Files that cannot be written are refused before the work, and others are replaced as a whole."""

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from aero_planner.output_files import check_folder, check_output_files, open_alone, whole_file


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


def test_two_programs_do_not_write_one_file(tmp_path: Path):
    path = tmp_path / "flight.mcap"
    path.write_bytes(b"old and long")
    with open_alone(path) as file:
        file.write(b"first")
        file.flush()
        with pytest.raises(OSError, match="another program is writing it"):
            open_alone(path)
    assert path.read_bytes() == b"first"
    with open_alone(path) as file:
        file.write(b"2nd")
    assert path.read_bytes() == b"2nd"
    with open_alone("/dev/null") as one, open_alone("/dev/null") as two:
        assert one.write(b"a") == two.write(b"a") == 1


def test_a_whole_file_is_written_by_one_program(tmp_path: Path):
    path = tmp_path / "out.txt"
    (tmp_path / ".out.partial.txt").write_text("of a program that was killed")
    with whole_file(path, alone=True) as partial:
        partial.write_text("mine")
        with pytest.raises(OSError, match="another program is writing it"), whole_file(path, alone=True):
            pass
    assert path.read_text() == "mine" and [file.name for file in tmp_path.iterdir()] == ["out.txt"]


def test_a_whole_file_may_be_opened_alone_by_who_writes_it(tmp_path: Path):
    path = tmp_path / "flight.mcap"
    with whole_file(path, alone=True) as partial, open_alone(partial) as file:
        file.write(b"mine")
    assert path.read_bytes() == b"mine" and os.listdir(tmp_path) == ["flight.mcap"]


def test_a_link_stays_and_a_device_is_written_itself(tmp_path: Path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with whole_file(tmp_path / "link.txt") as partial:
        partial.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    (tmp_path / "null").symlink_to(os.devnull)
    with whole_file(tmp_path / "null", alone=True) as device:
        assert str(device) == os.devnull


def test_threads_of_one_program_do_not_disturb_each_other(tmp_path: Path):
    path = tmp_path / "out.txt"
    with whole_file(path) as partial:
        partial.write_text("first")
        with ThreadPoolExecutor(1) as pool:

            def write() -> None:
                with whole_file(path) as other:
                    other.write_text("second")

            pool.submit(write).result()
        assert path.read_text() == "second"
    assert path.read_text() == "first" and os.listdir(tmp_path) == ["out.txt"]


@pytest.mark.parametrize("old", ["", "old"])
@pytest.mark.parametrize("is_whole", [True, False])
def test_what_another_program_has_written_meanwhile_is_kept(tmp_path: Path, old: str, is_whole: bool):
    path = tmp_path / "out.txt"
    if old:
        path.write_text(old)

    def write(text: str) -> None:
        if is_whole:
            with whole_file(path, alone=True) as partial:
                partial.write_text(text)
        else:
            with open_alone(path) as file:
                file.write(text.encode())

    check_output_files(path, overwrite=True)
    path.write_text("the work of hours")
    with pytest.raises(OSError, match="another program has written it since this one began"):
        write("new")
    assert path.read_text() == "the work of hours" and os.listdir(tmp_path) == ["out.txt"]
    check_output_files(path, overwrite=True)
    for text in ("first", "second"):
        write(text)
        assert path.read_text() == text
