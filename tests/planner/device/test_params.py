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
        expected = info.choices.index(str(value)) if info.choices else np.float32(value)  # type: ignore[arg-type]
        assert record[info.name] == expected, info.path


@pytest.mark.parametrize(("shape", "number"), [("quadratic", 0), ("exponential", 1)])
def test_a_choice_is_its_number_and_a_switch_0_or_1(shape: str, number: int):
    record = pack(PlannerConfig().replace({"costs.shape": shape, "costs.use_ground": bool(number)}))
    assert record["shape"] == number and record["use_ground"] == number
