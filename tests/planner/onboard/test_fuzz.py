"""A few thousand inputs of the fuzzer; `fuzz.py --seconds 600` runs millions."""

from __future__ import annotations

import pytest

from tests.planner.onboard import fuzz


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("target", list(fuzz.TARGETS))
def test_no_input_from_the_network_breaks_a_parser(target, seed):
    count, growth = fuzz.run(target, seed=seed, batches=80)
    assert count == 80 * fuzz.BATCH
    assert growth <= fuzz.GROWTH
