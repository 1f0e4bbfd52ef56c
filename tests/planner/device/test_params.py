"""The live parameters as kernels read them."""

from typing import Any

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.device.params import Params, pack


def test_each_live_parameter_is_a_field():
    live = [info for info in PlannerConfig.parameters() if info.live]
    assert set(Params.vars) == {info.name for info in live}
    record: Any = pack(PlannerConfig())
    for info in live:
        value = PlannerConfig().get(info.path)
        if info.pack is None:
            expected = info.choices.index(str(value)) if info.choices else np.float32(value)  # type: ignore[arg-type]
            assert record[info.name] == expected, info.path


def test_views_are_rows_of_numbers():
    record = pack(PlannerConfig().replace({"unseen_space.view": "-29 29 87.5; -7 52 360 180"}))
    np.testing.assert_array_equal(record["view"], [[-29.0, 29.0, 87.5, 0.0], [-7.0, 52.0, 360.0, 180.0]])
    record = pack(PlannerConfig())
    np.testing.assert_array_equal(record["view"], [[-7.0, 52.0, 360.0, 0.0], [0.0, 0.0, 0.0, 0.0]])


@pytest.mark.parametrize(("shape", "number"), [("quadratic", 0), ("exponential", 1)])
def test_a_choice_is_its_number_and_a_switch_0_or_1(shape: str, number: int):
    record = pack(PlannerConfig().replace({"costs.shape": shape, "costs.use_ground": bool(number)}))
    assert record["shape"] == number and record["use_ground"] == number
