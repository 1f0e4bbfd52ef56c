"""Conditions of a flight that a user chooses."""

from dataclasses import replace

import pytest

from aero_planner import PlannerConfig
from aero_viz.cli.flags import FlightFlags, NoiseFlags, WorldFlags
from aero_viz.cli.page import flight_opener
from aero_viz.errors import UserError
from aero_viz.flight import StateNoise, VehicleModel
from aero_viz.flight.conditions import conditions_of, with_conditions
from aero_viz.sensors.models import LIDARS
from aero_viz.session.source import Conditions

OPTIONS = {"lidar": replace(LIDARS["mid360"], range_max=20.0), "vehicle": VehicleModel(drag=0.2), "noise": None}


def test_the_conditions_of_a_flight_change_nothing():
    assert with_conditions(OPTIONS, conditions_of(OPTIONS)) == OPTIONS
    noisy = {**OPTIONS, "noise": StateNoise(position=0.1, correlation_time=3.0)}
    assert with_conditions(noisy, conditions_of(noisy)) == noisy


def test_conditions_replace_what_they_name():
    values = {"noise.position": 0.05, "drone.gust_speed": 2.0}
    changed = with_conditions(OPTIONS, Conditions(lidar="spinning64", values=values))
    assert changed["lidar"] is LIDARS["spinning64"]
    assert changed["noise"] == StateNoise(position=0.05)
    assert changed["vehicle"] == VehicleModel(drag=0.2, gust_speed=2.0)


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        (Conditions(values={"noise.position": -1.0}), "noise.position is -1.0"),
        (Conditions(values={"drone.gust_speed": 2.0, "drone.drag": 0.0}), "set drone.drag too"),
        (Conditions(values={"drone.mass": 2.0}), "drone.mass is not a condition"),
        (Conditions(lidar="mid361"), "There is no LiDAR"),
    ],
)
def test_wrong_conditions_are_refused_with_a_reason(conditions, words):
    with pytest.raises((UserError, ValueError), match=words):
        with_conditions(OPTIONS, conditions)


def test_the_page_opens_a_scene_with_its_conditions_and_otherwise_with_those_of_the_flags():
    flags = FlightFlags(noise=NoiseFlags(position=0.03))
    opener = flight_opener("forest", WorldFlags(count=3), flags, PlannerConfig(), lidar="mid360", device="cpu")
    first = opener("forest", seed=1)
    assert first.info.name == "forest-3-1" and first.info.settings["noise"]["position"] == 0.03
    other = opener("forest", seed=1, conditions=Conditions(count=5, values={"noise.position": 0.0}))
    assert other.info.name == "forest-5-1" and other.info.settings["noise"] is None
    for source in (first, other):
        source.close()
