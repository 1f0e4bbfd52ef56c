import dataclasses

import pytest

from aero_viz.flight import FlightRules, StateNoise, VehicleModel
from aero_viz.sensors import LidarModel

KINDS = [(VehicleModel, {}, "drone"), (StateNoise, {}, "noise"), (FlightRules, {}, "rules"),
         (LidarModel, {"name": "odd"}, "lidar")]  # fmt: skip
KEEP = {"drag": {"gust_speed": 0.0}, "gust_speed": {"drag": 0.1}, "rings": {"pattern": "rings"}}
"""Other parameters that must be set with a parameter, so that the two do not contradict each other."""
FOLLOWING = {"name", "mount_position", "mount_angles", "others", "model", "own"}
"""Fields that no user sets by a number: names, poses, further sensors, and what the vehicle model says."""


def fields() -> list[tuple[type, dict, str, str]]:
    return [(kind, base, section, info.name) for kind, base, section in KINDS for info in kind.parameters()]


def test_every_field_of_the_simulator_is_a_parameter():
    for kind, _, _ in KINDS:
        known = {info.name for info in kind.parameters()}
        assert known == {f.name for f in dataclasses.fields(kind)} - FOLLOWING
        for info in kind.parameters():
            allowed = info.default in info.choices or info.low <= info.default <= info.high  # type: ignore[operator]
            assert allowed and info.help.endswith(".")


@pytest.mark.parametrize(("kind", "base", "section", "name"), fields())
def test_bounds_are_checked_and_named(kind: type, base: dict, section: str, name: str):
    info = next(info for info in kind.parameters() if info.name == name)
    expected = f"one of {', '.join(info.choices)}" if info.choices else r"a .*number in \["
    for value in (info.low - 1.0, info.high * 1.5 + 1.0, float("nan"), "3", None):
        with pytest.raises(ValueError, match=rf"^{section}\.{name} is .*; it must be {expected}"):
            kind(**base, **KEEP.get(name, {}), **{name: value})


def test_numbers_are_converted_to_the_type_of_the_parameter():
    rules = FlightRules(time_limit=3, ticks_per_plan=5.0)  # type: ignore[arg-type]
    assert (type(rules.time_limit), type(rules.ticks_per_plan)) == (float, int)
    with pytest.raises(ValueError, match=r"rules\.ticks_per_plan is 2\.5; it must be a whole number"):
        FlightRules(ticks_per_plan=2.5)  # type: ignore[arg-type]
