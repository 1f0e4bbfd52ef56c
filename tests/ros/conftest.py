"""A graph of ROS 2 of each test's own: a domain, this process and helper processes, on this machine only."""

from __future__ import annotations

import importlib.util
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_viz.ros.graph import Graph

if importlib.util.find_spec("rclpy") is None and os.environ.get("CI") != "true":
    collect_ignore_glob = ["test_*.py"]  # there are no wheels of ROS 2 for this machine

Start = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    """A domain that no other test uses now, reached from this machine only; helper processes inherit it."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 4
    # Each worker has its own domains; beyond 101, ports may be those of other programs.
    number = 1 + 25 * worker + random.SystemRandom().randrange(25)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return number


@pytest.fixture
def graph(domain: int) -> Iterator[Graph]:
    """A node of this process in the domain."""
    with Graph("test") as joined:
        yield joined


@pytest.fixture
def start(domain: int) -> Iterator[Start]:
    """Start a module in another process of the domain: start("tests.ros.driver", "--rate", "10").

    A process that prints the line "ready" first has joined the graph when this returns.
    """
    processes: list[subprocess.Popen[str]] = []

    def run(module: str, *arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", module, *arguments]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.strip() == "ready", f"{module} says {line!r}"
        return process

    yield run
    for process in processes:
        process.terminate()
    for process in processes:
        process.wait(20)


def wait_until(condition: Callable[[], object], *, timeout: float = 30.0) -> None:
    """Wait until a condition holds. AssertionError if it does not hold in time [s]."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout:g} s"
        time.sleep(0.02)


def points_of(cloud: Any) -> NDArray[np.float32]:
    """Return the points of a sensor_msgs/PointCloud2 that has no field but of four bytes [m], [P, 3]."""
    rows = np.frombuffer(cloud.data, np.float32).reshape(-1, cloud.point_step // 4)
    assert [(field.name, field.offset) for field in cloud.fields[:3]] == [("x", 0), ("y", 4), ("z", 8)]
    return rows[:, :3]
