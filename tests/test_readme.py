"""The README's examples run as they stand, and its commands exist."""

from __future__ import annotations

import re
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_there_are_five_short_examples() -> None:
    assert len(EXAMPLES) == 5
    assert all(len(example.splitlines()) <= 15 for example in EXAMPLES)


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_an_example_runs_and_prints_nothing_but_its_results(example: str, tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-c", example], input="\n", capture_output=True, text=True, cwd=tmp_path, timeout=300
    )
    assert (result.returncode, result.stderr) == (0, "")
    assert result.stdout.strip() and "Warp" not in result.stdout and "Module" not in result.stdout


def test_the_page_of_an_example_stays_until_enter() -> None:
    (example,) = (example for example in EXAMPLES if "input(" in example)
    command = [sys.executable, "-u", "-c", example]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert process.stdout.read(len("Enter ends it ")) == "Enter ends it "
        with urllib.request.urlopen(address, timeout=20) as page:
            assert page.status == 200
        process.communicate("\n", timeout=60)
    assert process.returncode == 0


def test_every_command_named_exists() -> None:
    verbs = set(re.findall(r"^aero-viz (\w+)", README, flags=re.MULTILINE))
    help = subprocess.run(
        [sys.executable, "-m", "aero_viz", "--help"], capture_output=True, text=True, check=False
    ).stdout
    assert verbs and all(verb in help for verb in verbs)


@pytest.mark.parametrize("link", sorted(set(re.findall(r"\]\((?!http)([^)#]+)\)", README))))
def test_links_lead_somewhere(link: str) -> None:
    assert (ROOT / link).exists()
