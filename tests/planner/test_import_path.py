"""The current folder gives no modules to the programs of the planner, nor to their child processes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from aero_planner import PlannerConfig
from aero_planner.import_path import child_environment, import_path, module_command
from aero_planner.onboard.failsafe_process import FailsafeProcess
from aero_planner.onboard.settings import OnboardConfig
from tests.stray_modules import INSTALLED, executed_modules, leave_what_python_imports, write_stray_modules


@pytest.fixture
def stray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with stray modules, which is on the path of this process as `python -c` puts it there."""
    write_stray_modules(tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    return tmp_path


def test_the_failsafe_process_starts_beside_stray_modules(stray: Path):
    process = FailsafeProcess(OnboardConfig(), PlannerConfig().vehicle, lambda: None)
    try:
        process.wait_until_running(60.0)
    finally:
        process.close()
    assert executed_modules(stray) == []


@pytest.mark.parametrize("arguments", [["config"], ["preflight"], ["run", "--config", "absent.yaml"]])
def test_the_program_runs_beside_stray_modules(stray: Path, arguments: list[str]):
    leave_what_python_imports(stray)
    environment = child_environment()
    del environment["PYTHONSAFEPATH"]
    done = subprocess.run([sys.executable, "-m", "aero_planner", *arguments], capture_output=True, env=environment)
    assert executed_modules(stray) == [] and b"Traceback" not in done.stderr, done.stderr


def test_an_empty_entry_of_pythonpath_is_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_stray_modules(tmp_path, INSTALLED)  # the interpreter itself would execute those of the standard library
    monkeypatch.chdir(tmp_path)
    command = Path(sys.executable).with_name("aero-planner")
    environment = os.environ | {"PYTHONPATH": os.pathsep + os.pathsep.join(import_path())}
    done = subprocess.run([sys.executable, command, "config"], capture_output=True, env=environment)
    assert executed_modules(tmp_path) == [] and b"Traceback" not in done.stderr, done.stderr


def test_a_package_that_is_installed_from_the_current_folder_stays(stray: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", ["", str(stray), *sys.path[1:], str(stray)])
    assert import_path().count(str(stray)) == 1 and import_path()[-1] == str(stray)


def test_a_module_that_is_run_by_itself_ignores_the_folder(stray: Path):
    leave_what_python_imports(stray)
    environment = child_environment()
    del environment["PYTHONSAFEPATH"]
    command = [sys.executable, "-m", "aero_planner.benchmark", "--help"]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    assert executed_modules(stray) == []


def test_a_child_gets_its_arguments_and_the_modules_of_this_process(stray: Path, monkeypatch: pytest.MonkeyPatch):
    (stray / "below").mkdir()
    (stray / "below" / "say.py").write_text("import numpy, sys\nif __name__ == '__main__': print(sys.argv[1:])\n")
    monkeypatch.syspath_prepend(stray / "below")
    environment = child_environment()
    del environment["PYTHONSAFEPATH"]  # as if Python were too old to know it
    done = subprocess.run(module_command("say", "a", "-b"), capture_output=True, text=True, env=environment)
    assert done.stdout == "['a', '-b']\n", done.stderr
    assert executed_modules(stray) == []


def test_a_folder_that_the_user_names_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), "/usr/lib"])
    monkeypatch.setenv("PYTHONPATH", "")
    assert import_path() == ["/usr/lib"]
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert import_path() == [str(tmp_path), "/usr/lib"]


def test_a_current_folder_that_was_removed_does_no_harm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    monkeypatch.setattr(sys, "path", ["", "/usr/lib"])
    assert import_path() == ["/usr/lib"]
