"""The test of large recordings with small ones; `python -m benchmarks.large_recording` writes 8 GB."""

import sys
from pathlib import Path

import pytest

from benchmarks.large_recording import SWEEP_POINTS, measure, write


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of the memory is read from /proc")
@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_memory_does_not_grow_with_the_recording(tmp_path: Path, kind: str):
    path = write(tmp_path, 150_000_000, kind=kind)
    size = sum(file.stat().st_size for file in ([path] if path.is_file() else path.iterdir()))
    report = measure(path)  # checks that every seek reads the sweep of its time
    assert report["sweeps"] == 150_000_000 // (16 * SWEEP_POINTS) == size // (16 * SWEEP_POINTS)
    assert report["memory_mb"] < 60.0
