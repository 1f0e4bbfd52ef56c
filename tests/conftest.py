"""Fixtures for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATASETS = Path(__file__).resolve().parents[2] / "shared" / "datasets"


@pytest.fixture(scope="session")
def shared_datasets() -> Path:
    """Folder of real recordings beside the checkout; in CI a missing one is a failure."""
    if not DATASETS.is_dir():
        message = f"real recordings are missing: {DATASETS} does not exist, tests on them did not run"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return DATASETS
