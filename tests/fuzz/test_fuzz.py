"""The first cases of the fuzzer; `make fuzz` runs them for an hour."""

from pathlib import Path

import pytest
from fuzz.cases import NAMES, TARGET, write_case, write_seed
from fuzz.worker import Worker

CASES = {
    "recording": 10, "capture": 2, "log": 10, "points": 10, "solids": 2, "poses": 10, "world": 40, "config": 40,
    "port": 10, "node": 40, "page": 2,
}  # fmt: skip
"""Cases of each kind, by target."""


@pytest.fixture(scope="module")
def worker():
    with Worker() as child:
        yield child


@pytest.mark.parametrize("name", NAMES)
def test_hostile_input_is_used_or_refused_within_the_limits(worker: Worker, tmp_path: Path, name: str):
    seeds, target = tmp_path / "seeds", TARGET[name]
    seeds.mkdir()
    if (whole := write_seed(name, seeds)) is not None:
        outcome = worker.run(target, whole)
        assert outcome.kind == "done", outcome.text
    for number in range(CASES[target]):
        outcome = worker.run(target, write_case(name, seeds, tmp_path, number))
        assert not outcome.is_failure, f"case {number}: {outcome.kind}: {outcome.text}"


def test_the_harness_finds_what_it_looks_for(worker: Worker, tmp_path: Path):
    text = worker.run("traceback", tmp_path)
    assert text.kind == "traceback" and "ZeroDivisionError" in text.text
    assert worker.run("memory", tmp_path).kind == "memory"
    assert worker.run("slow", tmp_path, seconds_max=0.5).kind == "slow"
    assert worker.run("crash", tmp_path).kind == "crash"
    assert worker.run("unnamed", tmp_path).kind == "unnamed"
