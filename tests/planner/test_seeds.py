"""Seeds of planners and batches."""

from typing import Any

import numpy as np
import pytest

from aero_planner.seeds import seeds_of_batch


@pytest.mark.parametrize(
    ("seed", "seeds"),
    [
        (3, [3, 4]),
        (np.arange(4)[3], [3, 4]),
        (np.uint32(3), [3, 4]),
        (np.array([5, 9]), [5, 9]),
        ((1, 2**40), [1, 2**40]),
    ],
)
def test_a_seed_gives_one_for_each_drone(seed: Any, seeds: list[int]):
    assert seeds_of_batch(seed, 2) == seeds
    assert all(type(number) is int for number in seeds_of_batch(seed, 2))


@pytest.mark.parametrize("seed", [1.5, None, "ab", [1, 2.5], {}.values])
def test_other_seeds_are_refused(seed: Any):
    with pytest.raises(ValueError, match="it must be a whole number, or one for each drone"):
        seeds_of_batch(seed, 2)
