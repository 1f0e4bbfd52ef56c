"""The first cases of the fuzzer; `make fuzz` runs them for an hour."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzz.mutation import write_case
from fuzz.seeds import SEEDS, mutable_files
from fuzz.worker import Worker

CASES = {"recording": 10, "points": 1, "poses": 10, "world": 40, "config": 40}
"""Cases for each seed. Maps are decoded in a process for each case, and take the longest."""


@pytest.fixture(scope="module")
def worker():
    with Worker() as child:
        yield child


@pytest.fixture
def seed(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "seeds" / request.param
    path.parent.mkdir()
    SEEDS[request.param][1](path)
    return path


@pytest.mark.parametrize("seed", SEEDS, indirect=True)
def test_a_damaged_file_is_used_or_refused_within_the_limits(worker: Worker, tmp_path: Path, seed: Path) -> None:
    target = SEEDS[seed.name][0]
    whole = worker.run(target, mutable_files(seed)[0])
    assert whole.kind == "done", whole.text
    for number in range(CASES[target]):
        outcome = worker.run(target, write_case(seed, tmp_path, number))
        assert not outcome.is_failure, f"case {number}: {outcome.kind}: {outcome.text}"


def test_the_harness_finds_what_it_looks_for(worker: Worker, tmp_path: Path) -> None:
    text = worker.run("traceback", tmp_path)
    assert text.kind == "traceback" and "ZeroDivisionError" in text.text
    assert worker.run("memory", tmp_path).kind == "memory"
    assert worker.run("slow", tmp_path).kind == "slow"
    assert worker.run("crash", tmp_path).kind == "crash"
    assert worker.run("unnamed", tmp_path).kind == "unnamed"
