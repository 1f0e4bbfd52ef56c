"""A few thousand of the fuzzer's datagrams; `fuzz.py --seconds 600` throws millions."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import fuzz


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("target", list(fuzz.TARGETS))
def test_nothing_that_comes_from_the_network_gets_through_broken(target, seed):
    count, growth = fuzz.run(target, seed=seed, batches=80)
    assert count == 80 * fuzz.BATCH
    assert growth <= fuzz.GROWTH
