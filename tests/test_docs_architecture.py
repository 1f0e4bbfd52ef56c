"""The files that docs/architecture.md names exist."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`([\w/]+(?:\.py|/))`", TEXT)))
FOLDERS = ("", "planner", "planner/aero_planner", "aero_viz", "aero_viz/dashboard/panels")


def test_the_page_names_files():
    assert len(NAMED) > 15


@pytest.mark.parametrize("name", NAMED)
def test_a_named_file_exists(name: str):
    assert any((ROOT / folder / name).exists() for folder in FOLDERS)
