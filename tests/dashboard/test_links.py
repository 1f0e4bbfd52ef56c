"""Links to a moment: there and back, and what is refused."""

import functools

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.cli.commands import COMMANDS
from aero_viz.cli.page import flight_opener
from aero_viz.cli.parser import parse
from aero_viz.dashboard.links import Link, Opening
from aero_viz.flight.known_drone import config_for_flight, config_without_facts
from aero_viz.session.source import Conditions, SourceInfo


def test_a_link_keeps_source_seed_time_conditions_and_configuration():
    config = PlannerConfig().replace({"costs.q_track": 8.5, "sampling.samples": 64, "costs.use_ground": False})
    conditions = Conditions(300, "full-sphere", {"noise.position": 0.1})
    link = Link.to_moment(Opening("maps/a b.json", 7, conditions), 4.24, config)
    again = Link.parse(link.query)
    assert again is not None and again == link
    assert PlannerConfig().replace(again.config) == config


DEMO = [
    "aero-viz demo verticals --seed 4 --count 50 --lidar spinning64 --drone.drag 0.2 --config paper "
    "--vehicle.speed-limit 3.0",
    "aero-viz demo forest --seed 3 --count 30 --lidar.dropout 0.1 --drone.latency 0.02 --noise.position 0.1 "
    "--rules.time-limit 30.0 --candidates.prefer-safe False",
    "aero-viz demo pillars --seed 0",
]


@pytest.mark.parametrize("command", DEMO)
def test_the_command_of_a_page_opens_the_same_flight(command):
    call = parse(COMMANDS, command.split()[1:], prog="aero-viz", description="")
    assert isinstance(call, functools.partial)
    flags = call.keywords
    spec, seed, world = flags["scene"], flags["seed"], flags["world_flags"]
    config = flags["config_flags"].load(speed=flags["speed"])
    options = {"lidar": flags["lidar"], "device": "cpu"}
    opener = flight_opener(spec, world, flags["flight_flags"], config, **options)
    source = opener(spec, seed=seed)
    source.close()
    flown = config_without_facts(config_for_flight(config, source.info), source.info)
    assert Opening(spec, seed, Conditions(world.count)).command(source.info, flown) == command


def test_the_command_of_a_recording_opens_the_file():
    source = SourceInfo("a", closed_loop=False, period=0.1, start=np.zeros(3))
    command = Opening("my data/a.mcap").command(source, PlannerConfig())
    assert command == "aero-viz play 'my data/a.mcap' --seed 0"


def test_an_address_without_a_source_has_no_link():
    assert Link.parse("") is None and Link.parse("?darkMode=1") is None


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("source=forest&seed=x", "seed = 'x'"),
        ("source=forest&time=nan", "time = 'nan'"),
        ("source=forest&time=-1", "not negative"),
        ("source=forest&costs.q_track=many", "costs.q_track = 'many'"),
        ("source=forest&costs.q_track=1e9", "costs.q_track"),
        ("source=forest&costs.use_ground=maybe", "True or False"),
        ("source=forest&color=red", "'color', which this version does not know; aero-viz parameters lists all"),
        ("source=forest&costs.q_trak=8", r"'costs\.q_trak', .* \(did you mean 'costs\.q_track'\?\)"),
    ],
)
def test_a_link_that_cannot_be_used_is_refused(query, words):
    with pytest.raises(ValueError, match=words):
        Link.parse(query)
