from __future__ import annotations

from aero_viz.doctor import Check, Report


def test_only_what_is_required_makes_a_machine_unhealthy() -> None:
    optional = Check("CUDA", "no GPU", ok=False, required=False, advice="Buy one.")
    missing = Check("viser", "not installed", ok=False, advice="pip install viser")
    assert Report((optional,)).healthy
    assert not Report((optional, missing)).healthy


def test_the_table_gives_advice_below_what_is_missing() -> None:
    lines = Report((Check("viser", "not installed", ok=False, advice="pip install viser"),)).format_table().splitlines()
    assert lines[0].startswith("MISSING viser")
    assert lines[1].strip() == "-> pip install viser"
