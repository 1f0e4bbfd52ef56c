import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from aero_planner import PlannerConfig
from benchmarks.floors import MACHINES, floors, main
from benchmarks.operations import Count, Latency, nominal_controls, partition_point, rollout

LATENCY = Latency(arithmetic=4, special=20)
ROOT = Path(__file__).resolve().parents[2]


def test_a_product_is_fused_with_its_sum():
    n = Count(LATENCY)
    a, b, c = n.inputs(3)
    assert (a * b + c).ready == 4 and n.operations == 2
    # The other product has to be available first.
    assert (a * b + b * c).ready == 8 and n.operations == 5
    assert ((a + b) * c).ready == 8
    assert (a * 2.0 - 1.0).special().ready == 24
    assert n.cycles == 24


def test_the_latency_is_that_of_the_longest_chain():
    n = Count(LATENCY)
    x, y = n.inputs(2)
    for _ in range(10):
        x = x + 1.0
    assert (x + y).ready == 44 and n.operations == 11


@pytest.mark.parametrize("count", [rollout, nominal_controls])
def test_steps_follow_each_other(count):
    one, ten, twenty = (count(LATENCY, steps) for steps in (1, 10, 20))
    assert twenty.cycles - ten.cycles == pytest.approx(10 * (ten.cycles - one.cycles) / 9, rel=0.1)
    assert twenty.operations - ten.operations == pytest.approx(10 * (ten.operations - one.operations) / 9, rel=0.1)


def test_the_latency_of_a_step_follows_from_its_equations():
    """The normalised attitude depends on its rate: a product and four fused sums, twice, a root and a product."""
    step = rollout(LATENCY, 11, noisy=False).cycles - rollout(LATENCY, 10, noisy=False).cycles
    assert 40 <= step <= 60
    # Three stages of 4 x 5 (rate) + 4 x 2 and four of 9 (axis) alone.
    assert 120 < rollout(LATENCY, 1, noisy=False).operations < 300
    assert rollout(LATENCY, 1).operations > rollout(LATENCY, 1, noisy=False).operations
    assert 40 < partition_point(LATENCY).operations < 100


def test_floors_grow_with_the_work():
    config = PlannerConfig()
    machine = MACHINES["h100"]
    one = floors(config, machine, points=1000, kept=500)
    batch = floors(config, machine, points=1000, kept=500, batch=8)
    twice = floors(config.replace({"sampling.samples": 2 * config.sampling.samples}), machine, points=2000, kept=500)
    for name, floor in one.items():
        assert batch[name].operations == 8 * floor.operations and batch[name].cycles == floor.cycles
    assert twice["rollouts"].operations == 2 * one["rollouts"].operations
    assert twice["partition"].operations == 2 * one["partition"].operations
    operations, _, latency = one["rollouts"].parts_us(machine, 1)
    assert latency > operations > 0.0
    on_two = one["rollouts"].parts_us(MACHINES["cpu"], 2)
    assert one["rollouts"].parts_us(MACHINES["cpu"], 1)[0] == pytest.approx(2 * on_two[0])


SHORT = ["--points", "2000", "--samples", "16", "--steps", "10", "--repeat", "2", "--json"]


def test_report(device: str, capsys: pytest.CaptureFixture[str]):
    assert main([*SHORT, "--device", device, "--batch", "2"]) == 0
    report = json.loads(capsys.readouterr().out)
    stages = report["stages"]
    assert stages["plan"]["measured us"] > stages["plan"]["floor us"] > 0.0
    named = [row["floor us"] for name, row in stages.items() if name != "plan" and row["floor us"]]
    assert sum(named) == pytest.approx(stages["plan"]["floor us"])
    if device == "cpu":
        assert stages["rollouts"]["times"] > 1.0


def test_another_processor_has_floors_only(capsys: pytest.CaptureFixture[str]):
    assert main([*SHORT, "--floor-of", "h200"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["floor_of"] == "h200"
    assert all(row["measured us"] is None for row in report["stages"].values())
    assert main([*SHORT[:-1], "--floor-of", "h100"]) == 0
    assert "3.35 TB/s" in capsys.readouterr().out


def test_a_closed_pipe_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as broken:
        command = [sys.executable, "-m", "benchmarks.floors", "--points", "1000", "--samples", "4", "--repeat", "1"]
        done = subprocess.run(command, stdout=broken, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert (done.returncode, done.stderr) == (141, "")
