"""The time to the first picture, with one start of the demo."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser

from benchmarks.first_picture import main, start_times

ROOT = Path(__file__).resolve().parents[2]


def test_the_picture_comes_after_the_address(browser: Browser, tmp_path: Path):
    times = start_times(ROOT, browser, str(tmp_path))
    assert 0.0 < times["address_s"] < times["picture_s"] and times["cpu_s"] > 0.0


def test_a_folder_without_a_checkout_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="is no checkout"):
        main(["--against", str(tmp_path)])
