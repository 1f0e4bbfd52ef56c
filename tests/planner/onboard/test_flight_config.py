from pathlib import Path

import pytest

from aero_planner.config import PlannerConfig
from aero_planner.onboard.flight_config import load_any_checked, load_checked
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.config_cases import write


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("vehicle:\n  mass: 3\n", 2, "vehicle.thrust_max is 16.35 N; it must exceed the weight of 29.43 N"),
        (
            "vehicle:\n  mass: 1\n  model: acceleration\n",
            3,
            "vehicle.model is acceleration; the node commands thrust and body rates, so it must be ctbr.",
        ),
        ("onboard:\n  limits:\n    hold_time: 1\n    fence_height_max: 0.5\n", 4, "limits.fence_height_min is 1.0"),
        (
            "onboard:\n  rates:\n    control: 10\n",
            3,
            "limits.deadline is 0.1; with a rates.control of 10 Hz",
        ),
        ("rates:\n  replan: 5\n", 2, "limits.plan_age is 0.3; with a rates.replan of 5 Hz"),
        ("limits:\n  plan_age: 2\n", 2, "it must be less than the planner's horizon"),
        ("onboard:\n  limits:\n    plan_age: 0.3\nsampling:\n  steps: 4\n", 3, "sampling.steps x sampling.dt"),
        ("onboard:\n  mavlink:\n    url: COM3\n", 3, "mavlink.url is 'COM3'; it must be a connection such as udpin:"),
    ],
)
def test_contradictions_name_file_and_line(tmp_path: Path, text: str, line: int, problem: str):
    path = write(tmp_path / "wrong.yaml", text)
    with pytest.raises(ValueError) as raised:
        load_any_checked(path)
    assert str(raised.value).startswith(f"{path}, line {line}: ") and problem in str(raised.value)


def test_the_file_is_named_whose_setting_is_in_force(tmp_path: Path):
    both = write(tmp_path / "both.yaml", "onboard:\n  limits:\n    plan_age: 0.3\nsampling:\n  steps: 4\n")
    own = write(tmp_path / "own.yaml", "onboard:\n  limits:\n    hold_time: 1\n    plan_age: 2\n")
    with pytest.raises(ValueError, match=r"both\.yaml, line 5: limits\.plan_age is 2\.0; it must be less than"):
        load_checked(both, own)  # the plan_age of both.yaml is not in force
    with pytest.raises(ValueError, match=r"own\.yaml, line 4: limits\.plan_age is 2\.0; it must be less than"):
        load_checked("default", own)


def test_presets_and_files_are_loaded(tmp_path: Path):
    px4 = PlannerConfig.preset("px4"), OnboardConfig()
    assert load_any_checked("px4") == load_checked("px4") == px4
    own = write(tmp_path / "own.yaml", "limits:\n  hold_time: 1\n")
    assert load_checked("px4", own) == (px4[0], OnboardConfig().replace({"limits.hold_time": 1.0}))
