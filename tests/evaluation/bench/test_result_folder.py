"""The files of a benchmark that a stranger may have written, and a folder that two programs write to."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import run_refused

from aero_viz.errors import UserError
from aero_viz.evaluation.bench import Run

HEADER = {"benchmark": "b", "seed": 0, "lidar": None, "simulation": {}, "config": {}, "versions": {}, "device": "cpu"}
FLIGHT = {"row": "r", "index": 0, "world_seed": 0, "arrived": True, "flight_time_s": 1.0}
DAMAGED = {
    "null": ("null", ""),
    "a list": ("[1]", ""),
    "no keys": ("{}", ""),
    "deep": ("[" * 200_000, ""),
    "a text as seed": (HEADER | {"seed": "0"}, ""),
    "rows that are numbers": (HEADER | {"rows": [1]}, ""),
    "rows that are a number": (HEADER | {"rows": 1}, ""),
    "escapes": (HEADER | {"config": "\x1b[31m"}, ""),
    "a flight that is a list": (HEADER, "[1]"),
    "a flight without a row": (HEADER, FLIGHT | {"row": None}),
    "a time that is a text": (HEADER, FLIGHT | {"flight_time_s": "1"}),
    "a part of a batch": (HEADER, FLIGHT | {"batch": 0}),
    "a damaged line before others": (HEADER, json.dumps(FLIGHT)[:20] + "\n" + json.dumps(FLIGHT)),
    "no UTF-8": (HEADER, "\udcff"),
}


def text_of(content: object) -> bytes:
    return (content if isinstance(content, str) else json.dumps(content)).encode("utf-8", "surrogateescape")


@pytest.mark.parametrize("name", DAMAGED)
@pytest.mark.parametrize("others", [1, 2])
def test_damaged_results_are_refused_by_name(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str, others: int
):
    header, flights = DAMAGED[name]
    (tmp_path / "run.json").write_bytes(text_of(header))
    (tmp_path / "flights.jsonl").write_bytes(text_of(flights))
    error = run_refused(capsys, "bench", "compare", *[str(tmp_path)] * (1 + others))
    assert str(tmp_path / ("flights.jsonl" if flights else "run.json")) in error and "choose another folder" in error
    assert error.count("\n") == 1 and "\x1b" not in error and "Errno" not in error


def test_what_is_no_folder_is_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (tmp_path / "file").touch()
    error = run_refused(capsys, "bench", "compare", *[str(tmp_path / "file")] * 2)
    assert "Not a directory; choose another folder" in error and "Errno" not in error


def test_two_runs_do_not_write_to_one_folder(fly: Callable[..., Run], tmp_path: Path):
    def fly_again(*_: object) -> None:
        for resume in (False, True):
            with pytest.raises(UserError, match=r"Cannot write the results to .*: another program is writing it"):
                fly("one", resume=resume)

    run = fly("one", batch=2, progress=fly_again)
    assert len(run.flights) == 6 and len((tmp_path / "one" / "flights.jsonl").read_text().splitlines()) == 6
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == ["flights.jsonl", "run.json"]
