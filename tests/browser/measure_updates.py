"""Measures the tick rate of the engine while a page is drawn in software, and the CPU time of each part.

Run it by hand. Other processes on the machine lower the rates, so their load is printed; they hardly change the CPU
time per tick and per update.
"""

import argparse
import functools
import threading
import time
from collections import defaultdict

import numpy as np
import psutil
from playwright.sync_api import ViewportSize

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.snapshot import launch_chromium
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session

_ENGINE = ("aero-viz-session", "aero-planner")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1000), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--onlookers", type=int, default=0, help="further pages, each in a tab of its own")
    arguments = parser.parse_args()
    session = Session(FlightSource(scene("forest", seed=0)))
    session.start(play=False)
    dashboard = Dashboard(session, port=0)
    received: list[list[int]] = [[] for _ in range(1 + arguments.onlookers)]

    try:
        with launch_chromium() as browser:
            size: ViewportSize = {"width": arguments.size[0], "height": arguments.size[1]}
            pages = [browser.new_page(viewport=size) for _ in received]
            for page, sizes in zip(pages, received, strict=True):
                count = functools.partial(lambda sizes, message: sizes.append(len(message)), sizes)
                page.on("websocket", lambda socket, count=count: socket.on("framereceived", count))
                page.goto(dashboard.url)
            page = pages[0]
            loaded = 0
            while loaded < (loaded := sum(map(len, received))) or not all(received):
                page.wait_for_timeout(3000)  # until the pages have loaded
            session.play()
            page.wait_for_timeout(500)
            page.evaluate("() => { window.n = 0; const f = () => { window.n++; requestAnimationFrame(f); }; f(); }")
            dashboard.update_ms.clear()
            for sizes in received:
                sizes.clear()
            started, frame, before = time.perf_counter(), session.frame, _spent()
            page.wait_for_timeout(int(1e3 * arguments.seconds))
            took, last, updates = time.perf_counter() - started, session.frame, list(dashboard.update_ms)
            spent = {who: used - before[who] for who, used in _spent().items()}
            drawn = page.evaluate("window.n")
    finally:
        dashboard.close()
        session.close()
    assert frame is not None
    assert last is not None and last.outcome is None, "the flight ended too early: measure for fewer seconds"
    ticks = last.index - frame.index
    others = spent["machine"] - spent["engine"] - spent["page"] - spent["browser"]
    print(f"planner ticks      {ticks / took:6.1f} /s, {1e3 * spent['engine'] / ticks:.1f} ms of CPU each")
    print(f"updates sent       {len(updates) / took:6.1f} /s, {1e3 * spent['page'] / len(updates):.1f} ms of CPU each, "
          f"{np.median(updates):.1f} ms until sent (median)")  # fmt: skip
    server = (spent["engine"] + spent["page"]) / (last.time - frame.time)
    print(f"server             {server:6.2f} s of CPU per second of flight")
    for sizes in received:
        kilobytes = 1e-3 * sum(sizes) / len(updates)
        print(f"page received      {len(sizes) / took:6.1f} messages/s, {kilobytes:.0f} kB an update")
    print(f"pictures drawn     {drawn / took:6.1f} /s, {spent['browser'] / took:.2f} cores for the browser")
    print(f"others             {others / took:6.2f} cores of {psutil.cpu_count()}")


def _spent() -> dict[str, float]:
    """Return the processor time so far [s] of the engine, of the page's threads, of the browser and of the machine."""
    process, spent = psutil.Process(), defaultdict[str, float](float)
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    for thread in process.threads():
        name = names.get(thread.id, "")
        who = "engine" if name.startswith(_ENGINE) else "driver" if name in ("", "MainThread") else "page"
        spent[who] += thread.user_time + thread.system_time
    for child in process.children(recursive=True):
        used = child.cpu_times()
        spent["browser"] += used.user + used.system
    whole = psutil.cpu_times()
    spent["machine"] = whole.user + whole.nice + whole.system
    return spent


if __name__ == "__main__":
    main()
