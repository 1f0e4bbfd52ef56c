"""Fixtures for all tests."""

from __future__ import annotations

import contextlib
import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import warp as wp

if TYPE_CHECKING:
    from playwright.sync_api import Browser


def _share_cores() -> None:
    """Give each worker of a parallel run its share of the cores, if there are as many.

    Planners on all cores would share them with those of the other workers, and threads that wait for one another cost
    a tenth of the time.
    """
    worker, workers = (os.environ.get(f"PYTEST_XDIST_{name}") for name in ("WORKER", "WORKER_COUNT"))
    if worker and workers and hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        if int(workers) <= len(cores):
            os.sched_setaffinity(0, cores[int(worker.removeprefix("gw")) :: int(workers)])


def _devices() -> list[str]:
    wp.config.log_level = wp.LOG_WARNING
    present = [str(device) for device in wp.get_devices()]
    return [name for name in ("cpu", "cuda:0") if name in present]


_share_cores()
QUICK_DRAWING = ("--disable-gpu-compositing", "--webgl-antialiasing-mode=none")
"""Flags for Chromium that halve the time in which a page is drawn in software."""
DATASETS = Path(__file__).resolve().parents[2] / "shared" / "datasets"
CASES = DATASETS.with_name("cases")


@pytest.hookimpl(hookwrapper=True)
def pytest_collection() -> Iterator[None]:
    """Import the tests without the garbage collector, and exempt from it what was imported.

    It takes a quarter of a second to look through that, and would do so again and again during the import.
    """
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def shared_datasets() -> Path:
    """Folder of real recordings beside the checkout; in CI a missing one is a failure."""
    if not DATASETS.is_dir():
        message = f"real recordings are missing: {DATASETS} does not exist, tests on them did not run"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return DATASETS


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """Folder of small files that were once misread, beside the checkout."""
    if not CASES.is_dir():
        pytest.skip(f"{CASES} does not exist, tests on its files did not run")
    return CASES


@pytest.fixture(scope="session", params=_devices())
def device(request: pytest.FixtureRequest) -> str:
    """Every device that can be computed on here."""
    return request.param


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """Chromium, one for all tests; in CI a missing one is a failure."""
    from aero_viz.dashboard.snapshot import launch_chromium
    from aero_viz.errors import UserError

    with contextlib.ExitStack() as stack:
        try:
            chromium = stack.enter_context(launch_chromium(*QUICK_DRAWING))
        except UserError as error:
            if os.environ.get("CI"):
                pytest.fail(str(error))
            pytest.skip(f"NO PAGE WAS TESTED: {error}")
        yield chromium
