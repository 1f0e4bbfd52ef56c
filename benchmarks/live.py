"""Measure a live stream of ROS 2: lost clouds, and the time from a cloud's stamp to its plan and to its picture.

    python -m benchmarks.live --seconds 60 --points 20000 --rate 50

A driver in another process publishes clouds and odometry with the time of this computer as stamps. With --page, a
browser draws what is planned and the pictures are timed, which takes more time than the planner on a machine without a
graphics card. Lost clouds are counted without.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from aero_planner.cli_util import run_command
from aero_viz.live.session import StreamSession
from aero_viz.live.setup import Wanted, find_setup
from aero_viz.live.source import StreamSource, Tick
from aero_viz.live.stream import Stream
from aero_viz.ros.feed import Feed
from aero_viz.ros.graph import Graph
from aero_viz.session.frame import Frame
from benchmarks.common import positive

_TOPICS = {"/points": "sensor_msgs/msg/PointCloud2", "/odometry": "nav_msgs/msg/Odometry"}
_SWEEP_RATE, _ODOMETRY_RATE = 10.0, 100.0
_LATE = 5.0
"""Time for the last clouds to arrive [s]."""


def measure(*, seconds: float, points: int, rate: float, device: str, page: bool) -> dict[str, Any]:
    """Return the figures of one run: counts, and median and 99th percentile of the delays [ms]."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", "97")
    sent = round(seconds * _SWEEP_RATE)
    with ExitStack() as stack:
        graph = stack.enter_context(Graph("benchmark"))
        stream = Stream("benchmark")
        feed = Feed(graph, stream)
        stack.callback(feed.close)
        feed.use(_TOPICS)
        command = [sys.executable, "-m", "tests.ros.driver", "--wait", "--points", str(points)]
        command += ["--odometry-rate", str(_ODOMETRY_RATE), *([] if page else ["--clouds", str(sent)])]
        driver = stack.enter_context(subprocess.Popen(command, cwd=Path(__file__).parents[1], stdin=subprocess.PIPE))
        stack.callback(driver.terminate)
        while "/points" not in stream.topics or stream.topics["/points"].count < 10:
            time.sleep(0.05)
        session = StreamSession(StreamSource(stream, find_setup(stream, Wanted()), rate=rate), device=device)
        stack.callback(session.close)
        delays: dict[int, float] = {}
        ticks: list[float] = []

        def take(frame: Frame) -> None:
            tick: Any = None if frame.checkpoint is None else frame.checkpoint.source
            assert isinstance(tick, Tick)
            ticks.append(time.monotonic())
            delays.setdefault(tick.stamp, 1e3 * (time.time() - 1e-9 * tick.stamp))

        before = psutil.Process().memory_info().rss
        session.tick()  # compiles what is new to this machine
        session.subscribe_ticks(take, name="benchmark")
        session.start()
        if page:
            sent_ms, drawn_ms = _measure_pictures(stack, session, seconds)
            return {
                "plans_per_second": len(ticks) / (ticks[-1] - ticks[0]),
                "stamp_to_plan_ms": _quantiles(list(delays.values())),
                "stamp_to_page_ms": _quantiles(sent_ms),
                "stamp_to_picture_ms": _quantiles(drawn_ms),
            }
        driver.wait()
        deadline = time.monotonic() + _LATE
        while stream.topics["/points"].count < sent and time.monotonic() < deadline:
            time.sleep(0.05)
        return {
            "clouds_sent": sent,
            "clouds_received": stream.topics["/points"].count,
            "clouds_left_out": sum(stream.topics["/points"].unused.values()),
            "plans_per_second": len(ticks) / (ticks[-1] - ticks[0]),
            "memory_growth_mb": round((psutil.Process().memory_info().rss - before) / 1e6),
            "stamp_to_plan_ms": _quantiles(list(delays.values())),
        }


def _measure_pictures(stack: ExitStack, session: StreamSession, seconds: float) -> tuple[list[float], list[float]]:
    """Return the times from the stamps of clouds to when their plans were sent to a browser, and drawn [ms].

    A plan counts as drawn when the page has answered in three pictures, one after the other, within six seconds.
    """
    from playwright.sync_api import sync_playwright

    from aero_viz.browser import find_chromium
    from aero_viz.dashboard import Dashboard
    from aero_viz.dashboard.viser_private import wait_until_drawn

    dashboard = Dashboard(session, port=0)
    stack.callback(dashboard.close)
    playwright = stack.enter_context(sync_playwright())
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    browser = playwright.chromium.launch(executable_path=find_chromium(), args=flags)
    stack.callback(browser.close)
    page = browser.new_page(viewport={"width": 960, "height": 540}, device_scale_factor=0.5)
    page.goto(dashboard.url)
    while not (clients := list(dashboard.server.get_clients().values())):
        time.sleep(0.1)
    wait_until_drawn(clients[0])
    sent: list[float] = []
    drawn: list[float] = []
    last, deadline = 0, time.monotonic() + seconds
    while time.monotonic() < deadline:
        frame = session.frame
        tick: Any = None if frame is None or frame.checkpoint is None else frame.checkpoint.source
        if not isinstance(tick, Tick) or tick.stamp == last:
            time.sleep(0.002)
            continue
        last = tick.stamp
        dashboard.drain()
        sent.append(1e3 * (time.time() - 1e-9 * last))
        wait_until_drawn(clients[0])
        drawn.append(1e3 * (time.time() - 1e-9 * last))
    return sent, drawn


def _quantiles(values: list[float]) -> dict[str, float]:
    median, high = np.percentile(values, [50, 99])
    return {"median": round(float(median), 1), "p99": round(float(high), 1)}


def main(argv: Sequence[str] | None = None) -> int:
    """Print the figures as JSON; return the exit code: 1 if a cloud was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=positive, default=60)
    parser.add_argument("--points", type=int, default=20_000)
    parser.add_argument("--rate", type=positive, default=50, help="plans per second")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--page", action="store_true", help="draw the page in a browser, and measure its pictures")
    figures = measure(**vars(parser.parse_args(argv)))
    print(json.dumps(figures, indent=2))
    return int(figures.get("clouds_received", 0) < figures.get("clouds_sent", 0))


if __name__ == "__main__":
    sys.exit(run_command(main))
