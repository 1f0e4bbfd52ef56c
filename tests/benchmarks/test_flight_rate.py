"""Flights per minute of small batches."""

from pathlib import Path

import pytest

from benchmarks.flight_rate import main

ROOT = Path(__file__).parents[2]


def test_batches_are_flown_with_two_checkouts(device: str, capsys: pytest.CaptureFixture[str]):
    small = ["--forests", "1", "--fields", "1", "--time-limit", "0.04", "--processes", "1", "--device", device]
    assert main([*small, "--against", str(ROOT)]) == 0
    _, *lines, ratios = capsys.readouterr().out.splitlines()
    assert lines[0] == lines[3] == str(ROOT)
    for i in (1, 4):
        assert lines[i].startswith("  1 forests: ") and "0 of 1 arrived; planner " in lines[i]
        assert lines[i + 1].startswith("  6 in six fields: ") and "planner.partition" in lines[i + 1]
    assert ratios.startswith("ratios: 1 forests ")


def test_a_folder_without_the_code_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="is no checkout of this repository"):
        main(["--against", str(tmp_path)])
