"""Fly for two hours before two browsers, one of them slow: `make soak`, or `make soak ARGS="--minutes 10 --hidden"`."""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
from playwright.sync_api import Error, Page, Playwright, sync_playwright
from soak.report import TICK_RATE, Sample, curve, problems, table, write_csv

from aero_viz.browser import CHROMIUM_FLAGS, find_chromium
from tests.browser.hiding import HIDE

_PERIOD = 5.0
"""Time between two samples [s]."""
_WARM_UP = 30.0
"""Time for both pages to load before the first sample [s]."""
_NICENESS = 10
"""Niceness of the browsers."""
_SLOWER, _BYTES_PER_SECOND = 4, 400_000
"""Slow page: factor on its CPU time, and rate of its network."""
_WATCH = """
window.soak = {last: performance.now(), longest: 0};
const changed = () => {
  const now = performance.now();
  soak.longest = Math.max(soak.longest, now - soak.last);
  soak.last = now;
};
new MutationObserver(changed).observe(document, {subtree: true, childList: true, characterData: true});
window.soak.take = () => {
  const age = Math.max(soak.longest, performance.now() - soak.last) / 1000;
  soak.longest = 0;
  return [age, performance.memory.usedJSHeapSize / 1e6];
};
"""
"""Script of the page: the longest time without any change of what it says, and the memory of its JavaScript."""
_SHOWN = "Number(document.getElementById('aero-curve-state').dataset.now)"
"""Expression of JavaScript: the time of the flight that the page shows [s]."""
_PRESENT = 0.5
"""Time by which a page that shows the present may be late [s of flight]."""


def main() -> int:
    """Run the soak, print its table, write its samples and its curve, and return 1 if something grew or froze."""
    parser = argparse.ArgumentParser(prog="soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=120.0, help="how long to run")
    parser.add_argument("--hidden", action="store_true", help="hide both pages, and slow neither of them down")
    parser.add_argument("--folder", type=Path, default=Path("build/soak"), help="where the samples are written")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    samples: list[Sample] = []
    try:
        with (
            serve() as (process, url),
            _niceness(),
            sync_playwright() as playwright,
            _page(playwright, url, slow=False) as fast,
            _page(playwright, url, slow=not options.hidden) as slow,
        ):
            fast.wait_for_timeout(1e3 * _WARM_UP)
            for page in (fast, slow):
                page.evaluate(f"hide({json.dumps(options.hidden)})")
            _watch(process, fast, slow, options.minutes, samples, options.folder)
            if options.hidden:
                _show(process, fast)
    except KeyboardInterrupt:
        print("Stopped; the run so far:")
    if not samples:
        return 1
    _write(samples, options.folder)
    print(table(samples))
    found = problems(samples)
    print("\n".join(found) or "Nothing grew, and no page stood still.")
    return int(bool(found))


def _write(samples: list[Sample], folder: Path) -> None:
    write_csv(samples, folder / "soak.csv")
    (folder / "soak.svg").write_text(curve(samples))
    (folder / "soak.md").write_text(table(samples) + "\n")


def _watch(
    process: subprocess.Popen[str], fast: Page, slow: Page, minutes: float, samples: list[Sample], folder: Path
) -> None:
    """Append a sample every few seconds. They are written as well, so that a long run can be looked at."""
    for page in (fast, slow):
        page.evaluate("soak.take()")
    server, start, before = psutil.Process(process.pid), time.monotonic(), figures(process)
    cpu_before, now = sum(server.cpu_times()[:2]), start
    while now < start + 60.0 * minutes:
        fast.wait_for_timeout(1e3 * _PERIOD)
        state, cpu, then, now = figures(process), sum(server.cpu_times()[:2]), now, time.monotonic()
        ticks = state["ticks"] - before["ticks"]
        (fast_age, fast_heap), (slow_age, slow_heap) = (page.evaluate("soak.take()") for page in (fast, slow))
        samples.append(
            Sample(
                minutes=(now - start) / 60.0,
                memory_mb=server.memory_info().rss / 1e6,
                cpu=(cpu - cpu_before) / (now - then),
                threads=server.num_threads(),
                files=server.num_fds(),
                ticks=ticks,
                missed=TICK_RATE * (state["played"] - before["played"]) - ticks,
                flights=state["flights"],
                clients=state["clients"],
                fast_age=fast_age,
                slow_age=slow_age,
                fast_heap_mb=fast_heap,
                slow_heap_mb=slow_heap,
                fast_process_mb=_process_mb(fast),
            )
        )
        before, cpu_before = state, cpu
        if len(samples) % 60 == 0:
            _write(samples, folder)
            print(f"{samples[-1]}", flush=True)


def _show(process: subprocess.Popen[str], page: Page) -> None:
    """Show a hidden page again, and print how long it takes to show the present."""
    late, started = figures(process)["time"] - page.evaluate(_SHOWN), time.monotonic()
    page.evaluate("hide(false)")
    while True:
        page.evaluate("new Promise(drawn => requestAnimationFrame(drawn))")
        if figures(process)["time"] - page.evaluate(_SHOWN) < _PRESENT:
            break
    print(f"The hidden page was late by {late:.1f} s of flight. It shows the present after "
          f"{time.monotonic() - started:.1f} s.")  # fmt: skip


def _process_mb(page: Page) -> float:
    """Return the resident memory of the process of a page [MB]."""
    assert page.context.browser is not None
    devtools = page.context.browser.new_browser_cdp_session()
    processes = devtools.send("SystemInfo.getProcessInfo")["processInfo"]
    devtools.detach()
    numbers = [process["id"] for process in processes if process["type"] == "renderer"]
    return sum(psutil.Process(number).memory_info().rss for number in numbers) / 1e6


def figures(process: subprocess.Popen[str]) -> dict[str, Any]:
    """Ask the server for its figures so far."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


@contextlib.contextmanager
def serve() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start the server in a process of its own, and return it with the address of the page."""
    command = [sys.executable, str(Path(__file__).with_name("server.py"))]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None and process.stdout is not None
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.stdin.close()
        try:
            process.wait(timeout=30.0)
        except subprocess.TimeoutExpired:
            process.kill()


@contextlib.contextmanager
def _niceness() -> Iterator[None]:
    """Let browsers that are started from here on give way to the server, as if they ran on other machines."""
    os.nice(_NICENESS)
    yield


@contextlib.contextmanager
def _page(playwright: Playwright, url: str, *, slow: bool) -> Iterator[Page]:
    """Open the page in a browser of its own."""
    browser = playwright.chromium.launch(executable_path=find_chromium(), args=list(CHROMIUM_FLAGS))
    try:
        page = browser.new_page(viewport={"width": 480, "height": 320})
        page.add_init_script(HIDE)
        page.add_init_script(_WATCH)
        if slow:
            devtools = page.context.new_cdp_session(page)
            devtools.send("Emulation.setCPUThrottlingRate", {"rate": _SLOWER})
            devtools.send("Network.enable")
            rates = {"downloadThroughput": _BYTES_PER_SECOND, "uploadThroughput": _BYTES_PER_SECOND}
            devtools.send("Network.emulateNetworkConditions", {"offline": False, "latency": 150, **rates})
        page.goto(url, timeout=120_000)
        if not slow:
            page.get_by_text("Curves", exact=True).first.click(timeout=120_000)
        yield page
    finally:
        with contextlib.suppress(Error):  # Ctrl-C ends the browser as well
            browser.close()


if __name__ == "__main__":
    sys.exit(main())
