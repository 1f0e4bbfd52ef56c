"""The checks of `aero-viz doctor`. The command itself is tested in tests/cli/test_tools.py."""

import importlib.metadata

import pytest

from aero_planner.check_report import Check, CheckReport
from aero_viz.cli.doctor import examine


def test_only_required_checks_make_a_machine_unhealthy():
    optional = Check("CUDA", "no GPU", ok=False, required=False, advice="Buy one.")
    missing = Check("viser", "not installed", ok=False, advice="pip install viser")
    assert CheckReport((optional,)).passed
    assert not CheckReport((optional, missing)).passed


def test_the_table_gives_advice_below_a_failed_check():
    report = CheckReport((Check("viser", "not installed", ok=False, advice="pip install viser"),))
    lines = report.format_table().splitlines()
    assert lines[0].startswith("FAIL  viser")
    assert lines[1].strip() == "-> pip install viser"


def test_missing_packages_are_reported_with_advice(monkeypatch: pytest.MonkeyPatch):
    find_version = importlib.metadata.version

    def version(name: str) -> str:
        if name in ("mcap", "playwright"):
            raise importlib.metadata.PackageNotFoundError(name)
        return find_version(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    report = examine()
    checks = {check.name: check for check in report.checks}
    assert not report.passed and "Something required is missing" in report.format_table()
    assert not checks["mcap"].ok and checks["mcap"].required and "pip install mcap" in checks["mcap"].advice
    assert not checks["playwright"].ok and not checks["playwright"].required
