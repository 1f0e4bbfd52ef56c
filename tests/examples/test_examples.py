"""The examples run as they are, in processes of their own, and the README lists all of them."""

import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SERVED = ("own_layer", "own_panel")
"""The examples that serve their page until Enter is pressed."""
OTHERS = ("ros_planner",)
"""The examples that are no program by themselves: `tests/ros/test_simulator.py` flies it."""
EXAMPLES = {path.stem: path for path in sorted((ROOT / "examples").glob("*.py"))}
OUTPUT = {
    "plan_once": r"OK: 16 candidates, chosen: instance \d+, .*closest to the pole: 0\.[3-9]\d m",
    "fly": r"forest.*: arrived after .*log: fly\.mcap, ",
    "fly_batch": r"q_track +5: \d of 2 arrived, .*q_track +15: \d of 2 arrived, ",
    "replay_recording": r"replay_recording\.mcap: mcap, .* 0\.00 s  OK +plans \d\.\d m ahead",
    "own_planner": r"sidestep: arrived after \d+\.\d s, 0\.[3-9]\d m",
    "own_source": r"crossing ball: arrived after ",
    **dict.fromkeys(SERVED, r"http://127\.0\.0\.1:\d+"),
    "own_scene": r"slalom-2-1: arrived after \d+\.\d s, (1[89]|2[0-5])\.\d m",
    "own_sensor": r"mid360: arrived, .* seen after 0\.1 s.*tilted32: arrived, at least 0\.[3-9]\d m",
    "own_format": r"centisweeps: 20 sweeps, 20 poses, 16 candidates at the wall",
    "own_cost_term": r"weight +0: arrived, 0\.1\d m .*weight 100: arrived, 0\.0\d m off the height, at a cost",
    "own_model": r"arrived after [34]\.\d m, at least 0\.[3-9]\d m from all pillars",
    "own_vehicle": r"default: \w+ after .*matched: arrived after ",
}


def test_each_example_has_an_expected_output():
    assert sorted(EXAMPLES) == sorted((*OUTPUT, *OTHERS))


def test_no_two_examples_write_the_same_file():
    files = [name for path in EXAMPLES.values() for name in re.findall(r'Path\("(.+?)"\)', path.read_text())]
    assert len(files) > 1 and sorted(set(files)) == sorted(files)


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name not in (*SERVED, *OTHERS)])
def test_an_example_prints_its_results_only(name: str, tmp_path: Path):
    command = [sys.executable, str(EXAMPLES[name])]
    result = subprocess.run(command, input="\n", capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert (result.returncode, result.stderr) == (0, "")
    assert re.search(OUTPUT[name], result.stdout, flags=re.DOTALL), result.stdout


def test_replay_recording_refuses_a_missing_file_in_one_sentence(tmp_path: Path):
    command = [sys.executable, str(EXAMPLES["replay_recording"]), "missing.mcap"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert (result.returncode, result.stdout) == (1, "")
    assert result.stderr == "replay_recording.py: missing.mcap does not exist; this folder holds no recording.\n"


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_is_short_and_explains_itself(name: str):
    text = EXAMPLES[name].read_text(encoding="utf-8")
    assert len(text.splitlines()) < 60
    assert text.startswith('"""')


@pytest.mark.parametrize("name", SERVED)
def test_the_page_of_an_example_is_served_until_enter_and_its_address_is_printed_only(name: str, tmp_path: Path):
    command = [sys.executable, "-u", str(EXAMPLES[name])]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        assert process.stdout is not None
        address = process.stdout.readline()
        with urllib.request.urlopen(address.strip(), timeout=60) as page:
            assert page.status == 200
        printed, error = process.communicate("\n", timeout=60)
    assert (process.returncode, error) == (0, "")
    assert re.search(OUTPUT[name], address + printed, flags=re.DOTALL), address + printed


def test_the_readme_lists_every_example():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert all(f"(examples/{name}.py)" in readme for name in EXAMPLES)
