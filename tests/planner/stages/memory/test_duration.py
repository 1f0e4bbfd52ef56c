"""For how long sweeps are remembered."""

import pytest

from aero_planner import PlannerConfig


@pytest.mark.parametrize(("speed_limit", "expected"), [(7.0, 3.0), (3.0, 3.0), (2.0, 4.5), (0.5, 12.0)])
def test_a_slow_drone_remembers_for_longer(speed_limit: float, expected: float):
    assert PlannerConfig().memory.sweep_memory(speed_limit) == expected
