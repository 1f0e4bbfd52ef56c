import re
from pathlib import Path

import pytest

from aero_planner.onboard.log_place import check_log_place, make_log_path


def test_a_path_without_the_ending_of_a_log_is_a_folder_which_is_created(tmp_path: Path):
    folder = tmp_path / "log" / "aero"
    assert check_log_place(folder) == tmp_path and not folder.exists()
    path = make_log_path(folder)
    assert path.parent == folder and re.fullmatch(r"flight_[0-9]{8}_[0-9]{6}\.mcap", path.name)
    assert folder.is_dir() and not path.exists()
    assert check_log_place(folder) == folder and not list(folder.iterdir())
    assert make_log_path(folder).parent == folder


def test_a_path_with_the_ending_of_a_log_is_a_file_unless_it_is_a_folder(tmp_path: Path):
    path = tmp_path / "a.mcap"
    assert make_log_path(path) == path and check_log_place(path) == tmp_path and not path.exists()
    path.mkdir()
    assert make_log_path(path).parent == path == check_log_place(path)


@pytest.mark.parametrize("name", ["absent/a.mcap", "file/log"])
def test_a_place_where_no_log_can_be_written_is_refused_with_advice(tmp_path: Path, name: str):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=rf"{name} can't be written: No.* directory.*name another place with --log"):
        check_log_place(tmp_path / name)


def test_a_file_without_the_ending_of_a_log_is_not_taken_for_a_folder(tmp_path: Path):
    path = tmp_path / "flight"
    path.touch()
    for prepare in (check_log_place, make_log_path):
        with pytest.raises(OSError, match=r"flight, which is a file: name a folder, or a file that ends in \.mcap"):
            prepare(path)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a file system on which nothing can be created")
@pytest.mark.parametrize("name", ["aero", "a.mcap"])
def test_a_file_system_on_which_nothing_can_be_created_is_refused(name: str):
    with pytest.raises(OSError, match=rf"/proc/self/{name} can't be written: .*create a folder that this user may"):
        check_log_place(Path("/proc/self") / name)
