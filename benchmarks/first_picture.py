"""Measure the time from the start of `aero-viz demo` to the first picture, also against another checkout."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aero_planner.cli_util import run_command
from benchmarks.common import add_against, checkout_path, checkouts, positive

if TYPE_CHECKING:
    from playwright.sync_api import Browser

_PICTURE = """
// Notes when points (mode 0) and rollouts (instances of a segment) have been drawn, and the GPU has finished.
let points = 0, rollouts = 0;
const context = WebGL2RenderingContext.prototype, {drawArrays, drawElementsInstanced} = context;
const note = (gl) => {
  if (points < 1000 || rollouts < 400 || window.pictureTime !== undefined) return;
  window.pictureTime = null;
  setTimeout(() => {
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    window.pictureTime = Date.now() / 1000;
  });
};
context.drawArrays = function (mode, first, count) {
  drawArrays.apply(this, arguments);
  if (mode === 0) { points = Math.max(points, count); note(this); }
};
context.drawElementsInstanced = function (mode, count, type, offset, instances) {
  drawElementsInstanced.apply(this, arguments);
  rollouts = Math.max(rollouts, instances); note(this);
};
"""
_TIMEOUT_MS = 120_000.0


def start_times(root: Path, browser: Browser, byte_code: str) -> dict[str, float]:
    """Start the demo with the code of a checkout, open its page as soon as the address is printed, and stop it again.

    Args:
        root: the checkout.
        browser: browser that runs already.
        byte_code: folder for Python's byte code, so that later starts find it compiled, as with an installed program.

    Returns:
        "address_s" and "picture_s" since the start; "cpu_s", the processor time that the server has taken until then.

    Raises:
        ValueError: the demo ended; the message is its last line.
    """
    path = checkout_path(root)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"PYTHONPATH": path, "PYTHONPYCACHEPREFIX": byte_code}
    command = [sys.executable, "-m", "aero_viz", "demo", "--port", "0"]
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.add_init_script(_PICTURE)
    began = time.time()
    with subprocess.Popen(
        command, cwd=root, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as demo:
        assert demo.stdout is not None and demo.stderr is not None
        try:
            words = demo.stdout.readline().split()
            address = time.time()
            if not words:
                raise ValueError(
                    f"the demo of {root} ended: {(demo.stderr.read().strip().splitlines() or ['no message'])[-1]}"
                )
            page.goto(next(word for word in words if word.startswith("http")), wait_until="commit")
            page.wait_for_function("window.pictureTime", timeout=_TIMEOUT_MS, polling=100)
            picture = page.evaluate("window.pictureTime")
            fields = Path(f"/proc/{demo.pid}/stat").read_text().rpartition(")")[2].split()
            cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        finally:
            demo.terminate()
            page.close()
    return {"address_s": address - began, "picture_s": picture - began, "cpu_s": cpu}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns 0.

    Raises:
        ValueError: as for `start_times`, or --against is no checkout.
    """
    from aero_viz.dashboard.snapshot import launch_chromium

    parser = argparse.ArgumentParser(prog="python -m benchmarks.first_picture", description=__doc__)
    add_against(parser)
    parser.add_argument("--repeat", type=positive, default=10, help="starts with each checkout, in turn")
    options = parser.parse_args(arguments)
    roots = checkouts(options)
    runs: dict[Path, list[dict[str, float]]] = {root: [] for root in roots}
    with launch_chromium() as browser, tempfile.TemporaryDirectory() as byte_code:
        for root in roots:
            start_times(root, browser, byte_code)  # compiles the byte code and the kernels
        for _ in range(options.repeat):
            for root in roots:
                runs[root].append(start_times(root, browser, byte_code))
    for root, times in runs.items():
        ordered = {name: sorted(run[name] for run in times) for name in times[0]}
        best = ", ".join(f"{name} {values[0]:.2f} ({values[len(values) // 2]:.2f})" for name, values in ordered.items())
        print(f"{root}: {best}; best and median of {options.repeat}")
    return 0


if __name__ == "__main__":
    run_command(main)
