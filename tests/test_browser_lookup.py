from pathlib import Path

import pytest

from aero_viz.browser import find_chromium
from aero_viz.errors import UserError


def test_the_users_choice_comes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    browser = tmp_path / "my-chromium"
    browser.write_text("")
    monkeypatch.setenv("AERO_VIZ_CHROMIUM", str(browser))
    assert find_chromium() == str(browser)


def test_a_wrong_choice_is_reported(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("AERO_VIZ_CHROMIUM", "/no/such/browser")
    with pytest.raises(UserError, match="AERO_VIZ_CHROMIUM names /no/such/browser"):
        find_chromium()


def test_a_script_that_only_names_a_snap_is_no_browser(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    stub = tmp_path / "chromium-browser"
    stub.write_text("#!/bin/sh\necho 'requires the chromium snap to be installed'\n")
    stub.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("AERO_VIZ_CHROMIUM", raising=False)
    monkeypatch.setattr("aero_viz.browser._playwright_chromium", lambda: None)
    with pytest.raises(UserError, match="No Chromium was found"):
        find_chromium()
