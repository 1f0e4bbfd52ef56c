"""The judgement of a soak, and the figures that its server gives."""

import dataclasses
import xml.etree.ElementTree as ElementTree

import pytest
from soak.__main__ import figures, serve
from soak.report import FREEZE, Sample, curve, problems, table

GOOD = Sample(
    minutes=0.0, memory_mb=300.0, cpu=0.9, threads=20, files=10, ticks=240, missed=10.0, flights=3, clients=2,
    fast_age=1.0, slow_age=4.0, fast_heap_mb=60.0, slow_heap_mb=60.0, fast_process_mb=300.0,
)  # fmt: skip


def run(**last: float) -> list[Sample]:
    """Return the samples of two hours whose fields grow evenly to the given values."""
    share = [k / 1439 for k in range(1440)]
    return [
        dataclasses.replace(
            GOOD,
            minutes=120.0 * s,
            **{name: getattr(GOOD, name) + s * (value - getattr(GOOD, name)) for name, value in last.items()},
        )
        for s in share
    ]


def test_a_run_in_which_nothing_happens_is_good():
    assert problems(run()) == []


@pytest.mark.parametrize(
    ("name", "value"),
    [("memory_mb", 400.0), ("threads", 30), ("files", 30), ("fast_heap_mb", 260), ("fast_process_mb", 700)],
)
def test_growth_is_found(name, value):
    assert any(name in problem for problem in problems(run(**{name: value})))


def test_memory_that_is_reached_at_the_start_is_no_growth():
    samples = [dataclasses.replace(sample, memory_mb=100.0 if sample.minutes < 20 else 300.0) for sample in run()]
    assert problems(samples) == []


@pytest.mark.parametrize("page", ["fast", "slow"])
def test_a_page_that_stands_still_is_found(page):
    samples = run()
    samples[700] = dataclasses.replace(samples[700], **{f"{page}_age": FREEZE + 1.0})
    assert problems(samples) == [f"The {page} page stood still for 31 s."]


def test_a_lost_page_is_found():
    assert problems([*run(), dataclasses.replace(GOOD, clients=1)]) == ["A page lost its connection."]


def test_table_and_curve_of_two_hours_are_small():
    rows = table(run()).splitlines()
    assert len(rows) == 10 and "| 48.0 | 4.0 % |" in rows[2]
    drawing = curve(run())
    assert len(drawing) < 8000
    lines = ElementTree.fromstring(drawing).findall("{*}polyline")
    assert len(lines) == 4 and all(len(line.attrib["points"].split()) == 90 for line in lines)


def test_the_server_flies_and_answers():
    with serve() as (process, url):
        assert url.startswith("http://127.0.0.1:")
        before = figures(process)
        while figures(process)["ticks"] < before["ticks"] + 20:
            pass
        assert figures(process)["played"] > before["played"]
