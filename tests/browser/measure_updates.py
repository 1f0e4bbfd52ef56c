"""Measures the tick rate of the engine while a page is drawn in software, and the CPU time of each part.

Run it by hand. Other processes on the machine lower the rates, so their load is printed; they hardly change the CPU
time per tick and per update.
"""

import argparse
import dataclasses
import functools
import multiprocessing
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
from playwright.sync_api import Page, ViewportSize

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.snapshot import launch_chromium
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, send

_ENGINE = ("aero-viz-session", "aero-planner")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--size", type=int, nargs=2, default=(1600, 1000), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--onlookers", type=int, default=0, help="further pages, each in a tab of its own")
    parser.add_argument("--curves", action="store_true", help="open the curves on every page")
    parser.add_argument("--ticks", type=int, default=0, help="ticks that the curves show already")
    parser.add_argument(
        "--remote", action="store_true", help="draw nothing, as if the browsers ran on other machines: only receive"
    )
    arguments = parser.parse_args()
    session = Session(FlightSource(scene("forest", seed=0)))
    session.start(play=False)
    dashboard = Dashboard(session, port=0)
    count = 1 + arguments.onlookers
    if arguments.ticks:
        _fly_before(session, dashboard, arguments.ticks)
    try:
        opened = _receivers if arguments.remote else _pages
        with opened(dashboard.url, count, arguments) as pages:
            session.play()
            pages.wait(0.5)
            dashboard.update_ms.clear()
            pages.clear()
            started, frame, before = time.perf_counter(), session.frame, _spent()
            pages.wait(arguments.seconds)
            received = pages.received()
            took, last, updates = time.perf_counter() - started, session.frame, list(dashboard.update_ms)
            spent = {who: used - before[who] for who, used in _spent().items()}
            drawn = pages.drawn()
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


def _fly_before(session: Session, dashboard: Dashboard, ticks: int) -> None:
    """Put ticks before the present one into the history."""
    session.step(1).result()
    frame = session.frame
    assert frame is not None
    for tick in range(ticks):
        dashboard.history.add(dataclasses.replace(frame, time=frame.time - 0.02 * (ticks - tick)))


@contextmanager
def _pages(url: str, count: int, arguments: argparse.Namespace) -> Iterator[Any]:
    """Open pages in a Chromium."""
    sizes: list[list[int]] = [[] for _ in range(count)]
    with launch_chromium() as browser:
        size: ViewportSize = {"width": arguments.size[0], "height": arguments.size[1]}
        pages: list[Page] = [browser.new_page(viewport=size) for _ in range(count)]
        for page, own in zip(pages, sizes, strict=True):
            note = functools.partial(lambda own, message: own.append(len(message)), own)
            page.on("websocket", lambda socket, note=note: socket.on("framereceived", note))
            page.goto(url)
        for page in pages if arguments.curves else []:
            page.get_by_role("button", name="Curves").click()
        _wait_until_loaded(sizes, lambda seconds: pages[0].wait_for_timeout(1e3 * seconds))
        pages[0].evaluate("() => { window.n = 0; const f = () => { window.n++; requestAnimationFrame(f); }; f(); }")

        def clear() -> None:
            pages[0].evaluate("window.n = 0")
            for own in sizes:
                own.clear()

        yield SimpleNamespace(
            wait=lambda seconds: pages[0].wait_for_timeout(int(1e3 * seconds)), clear=clear,
            received=lambda: [list(own) for own in sizes], drawn=lambda: pages[0].evaluate("window.n"),
        )  # fmt: skip


@contextmanager
def _receivers(url: str, count: int, arguments: argparse.Namespace) -> Iterator[Any]:
    """Connect clients that receive what a page receives, in a process of their own."""
    here, there = multiprocessing.Pipe()
    what = url, count, arguments.curves, there
    process = multiprocessing.get_context("spawn").Process(target=_receive, args=what, daemon=True)
    process.start()
    assert here.recv() == "loaded"

    def ask(question: str) -> Any:
        here.send(question)
        return here.recv()

    yield SimpleNamespace(
        wait=time.sleep, clear=lambda: ask("clear"), received=lambda: ask("received"), drawn=lambda: 0
    )
    process.terminate()
    process.join()


def _receive(url: str, count: int, curves: bool, parent: Connection) -> None:
    server: Any = SimpleNamespace(url=url)
    sizes: list[list[int]] = [[] for _ in range(count)]

    def read(client: Any, own: list[int]) -> None:
        for message in client:
            own.append(len(message))

    for own in sizes:
        client = join(server)
        send(client, **CAMERA)
        if curves:
            send(client, type="AeroCurvesMessage", is_open=True, signals=None, span=None, width=1000)
        threading.Thread(target=read, args=(client, own), daemon=True).start()
    _wait_until_loaded(sizes, time.sleep)
    parent.send("loaded")
    while True:
        if parent.recv() == "clear":
            for own in sizes:
                own.clear()
            parent.send(None)
        else:
            parent.send([list(own) for own in sizes])


def _wait_until_loaded(sizes: Sequence[list[int]], wait: Callable[[float], object]) -> None:
    """Wait until every page has received messages, and none receives more for three seconds."""
    loaded = 0
    while loaded < (loaded := sum(map(len, sizes))) or not all(sizes):
        wait(3.0)


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
