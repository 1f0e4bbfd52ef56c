"""Finds a Chromium for snapshots and browser tests."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from aero_viz.errors import UserError

CHROMIUM_FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
)
"""Flags that let a headless Chromium render WebGL without a GPU, even as root in a container."""

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")


def find_chromium() -> str:
    """Return the path of a Chromium: $AERO_VIZ_CHROMIUM, an installed one, or the one that Playwright downloaded.

    Raises:
        UserError: there is none; says how to get one.
    """
    chosen = os.environ.get("AERO_VIZ_CHROMIUM")
    if chosen:
        if not Path(chosen).is_file():
            raise UserError(f"AERO_VIZ_CHROMIUM names {chosen}, which is not a file; correct or unset it.")
        return chosen
    for name in _NAMES:
        path = shutil.which(name)
        # Ubuntu installs a script under this name that only asks the user to install a snap.
        if path and not _is_snap_stub(path):
            return path
    downloaded = _playwright_chromium()
    if downloaded:
        return downloaded
    raise UserError(
        "No Chromium was found; install one (Debian: sudo apt-get install chromium; elsewhere: "
        "python -m playwright install --with-deps chromium) or set AERO_VIZ_CHROMIUM to its path."
    )


def _is_snap_stub(path: str) -> bool:
    with open(path, "rb") as file:
        head = file.read(4096)
    return head.startswith(b"#!") and b"snap" in head and not Path("/snap/bin/chromium").exists()


def _playwright_chromium() -> str | None:
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    with sync_playwright() as playwright:
        path = playwright.chromium.executable_path
    return path if Path(path).is_file() else None
