"""Processor time of the plans of a flight."""

from pathlib import Path

import pytest

from benchmarks.flight_plans import main

ROOT = Path(__file__).parents[2]


def test_plans_of_a_flight_are_timed_against_another_checkout(capsys: pytest.CaptureFixture[str]):
    assert main(["--ticks", "5", "--repeat", "1", "--against", str(ROOT)]) == 0
    here, *_ = lines = capsys.readouterr().out.splitlines()
    assert here.startswith(f"{ROOT}: median ") and here.endswith(" plans")
    assert lines[-1].startswith("ratio of the medians: ")


def test_a_folder_without_the_code_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="is no checkout of this repository"):
        main(["--against", str(tmp_path)])
