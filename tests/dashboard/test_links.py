"""Links to a moment: there and back, and what is refused."""

import pytest

from aero_planner import PlannerConfig
from aero_viz.dashboard.links import Link, Opening
from aero_viz.session.source import Conditions


def test_a_link_keeps_source_seed_time_conditions_and_configuration():
    config = PlannerConfig().replace({"costs.q_track": 8.5, "sampling.samples": 64, "costs.use_ground": False})
    conditions = Conditions(300, "full-sphere", {"noise.position": 0.1})
    link = Link.to_moment(Opening("maps/a b.json", 7, conditions), 4.24, config)
    again = Link.parse(link.query)
    assert again is not None and again == link
    assert PlannerConfig().replace(again.config) == config


def test_the_command_opens_the_same_source():
    assert Opening("forest", 3).command(closed_loop=True) == "aero-viz demo forest --seed 3"
    assert Opening("my data/a.mcap").command(closed_loop=False) == "aero-viz play 'my data/a.mcap' --seed 0"


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
