"""The README's Python code runs as it is, its commands exist, and its links lead somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import run

from aero_viz.cli.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
LINES = re.findall(r"^aero-viz (\w+)(?: (\w+))?(.*?)(?: #|$)", README, flags=re.MULTILINE)
USES = [
    (f"{name} {second}", rest) if f"{name} {second}" in COMMANDS else (name, f"{second}{rest}")
    for name, second, rest in LINES
]


def test_the_snippets_are_few_and_short():
    assert 2 <= len(SNIPPETS) <= 3
    assert all(len(snippet.splitlines()) <= 15 for snippet in SNIPPETS)


@pytest.mark.parametrize("snippet", SNIPPETS, ids=range(len(SNIPPETS)))
def test_a_snippet_runs_and_prints_its_results_only(snippet: str, tmp_path: Path):
    result = subprocess.run([sys.executable, "-c", snippet], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.strip() and "Warp" not in result.stdout and "Module" not in result.stdout


def test_the_session_flies_as_the_command_does(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    snippet = next(snippet for snippet in SNIPPETS if "Session(" in snippet)
    beginning = snippet[: snippet.index("session.seek")]
    code = f"{beginning}print(*frames[-1].observation.actual_state.position)\nsession.close()\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    table = tmp_path / "t.csv"
    options = ("--rules.time-limit", "1", "--trajectory", str(table))
    assert run(capsys, "fly", "forest", "--seed", "3", *options)[0] == 0
    row = table.read_text(encoding="utf-8").splitlines()[1 + 49]
    place = [float(number) for number in row.split(",")[1:4]]
    assert list(map(float, done.stdout.split())) == pytest.approx(place, abs=1e-6)


def test_every_command_exists_with_its_flags(capsys: pytest.CaptureFixture[str]):
    assert {name for name, _ in USES} >= COMMANDS.keys() - {"score", "world export", "doctor", "bench compare"}
    for name, arguments in USES:
        _, text, _ = run(capsys, *name.split(), "--help")
        missing = [flag for flag in re.findall(r"--[a-z][a-z.-]*", arguments) if flag not in text]
        assert not missing, (name, missing)


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\((?!http)([^)#]+)\)", README))))
def test_links_lead_somewhere(link: str):
    assert (ROOT / link).exists()
