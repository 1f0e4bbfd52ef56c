"""Scene updates per second that one page gets while the forest flies; run by hand."""

from __future__ import annotations

import argparse
import time

import numpy as np

from aero_viz.dashboard import Dashboard
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session
from aero_viz.snapshot import launch_chromium


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1000), metavar=("WIDTH", "HEIGHT"))
    arguments = parser.parse_args()
    session = Session(FlightSource(scene("forest", seed=0)))
    session.start(play=False)
    dashboard = Dashboard(session, port=0)
    received = [0]
    try:
        with launch_chromium() as browser:
            page = browser.new_page(viewport={"width": arguments.size[0], "height": arguments.size[1]})
            page.on("websocket", lambda socket: socket.on("framereceived", lambda _: _count(received)))
            page.goto(dashboard.url)
            page.wait_for_timeout(3000)
            session.play()
            page.wait_for_timeout(500)
            page.evaluate("() => { window.n = 0; const f = () => { window.n++; requestAnimationFrame(f); }; f(); }")
            dashboard.update_ms.clear()
            received[0], started, frame = 0, time.perf_counter(), session.frame
            page.wait_for_timeout(int(1e3 * arguments.seconds))
            took, last, updates = time.perf_counter() - started, session.frame, list(dashboard.update_ms)
            drawn = page.evaluate("window.n")
    finally:
        dashboard.close()
        session.close()
    assert frame is not None
    assert last is not None
    print(f"updates sent       {len(updates) / took:6.1f} /s, {np.median(updates):.1f} ms of Python each (median)")
    print(f"messages received  {received[0] / took:6.1f} /s")
    print(f"pictures drawn     {drawn / took:6.1f} /s")
    print(f"planner ticks      {(last.index - frame.index) / took:6.1f} /s")


def _count(received: list[int]) -> None:
    received[0] += 1


if __name__ == "__main__":
    main()
