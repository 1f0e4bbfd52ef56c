"""What the planner is told of the ground, from one world to the next."""

from __future__ import annotations

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_planner import PlannerConfig
from aero_viz.flight import FlightSource
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session
from aero_viz.session.ground import move_ground, preset_above
from aero_viz.session.source import Observation

OFF = -1000.0
PAPER = PlannerConfig.preset("paper")


class Blind(FlightSource):
    """Cannot be observed."""

    def observe(self) -> Observation:
        raise ValueError("there is nothing to see.")


def source_above(ground: float | None, kind: type[FlightSource] = FlightSource) -> FlightSource:
    """A flight 2 m above flat ground, or above none."""
    height = 0.0 if ground is None else ground
    boxes = np.array([[5.0, 0.0, height - 0.5, 60.0, 60.0, 1.0, 0.0]])
    start = np.array([0.0, 0.0, height + 2.0])
    world = World("valley", start, np.add(start, (12.0, 0.0, 0.0)), boxes=boxes[: 0 if ground is None else 1])
    return kind(world, lidar=LidarModel("sparse", points_per_sweep=2000))


def with_floor(floor: float) -> PlannerConfig:
    return PlannerConfig().replace({"costs.floor": floor})


@pytest.mark.parametrize(("ground", "floor"), [(-2.5, -2.5), (None, OFF), (-5000.0, OFF), (5000.0, 1000.0)])
def test_presets_are_told_of_the_ground_as_far_as_a_floor_can_lie(ground: float | None, floor: float) -> None:
    assert preset_above("default", ground) == with_floor(floor)
    assert preset_above("paper", ground) == PAPER


@pytest.mark.parametrize(
    ("config", "before", "after", "floor"),
    [
        (with_floor(0.0), 0.0, -10.0, -10.0),
        (with_floor(0.0), 0.0, None, OFF),
        (with_floor(OFF), None, 3.0, 3.0),
        (with_floor(0.7), 0.0, -10.0, 0.7),
        (with_floor(OFF), 0.0, -10.0, OFF),
        (PAPER, None, 3.0, OFF),
    ],
)
def test_a_floor_that_was_told_goes_with_the_ground_and_one_that_was_chosen_stays(
    config: PlannerConfig, before: float | None, after: float | None, floor: float
) -> None:
    assert move_ground(config, before, after) == config.replace({"costs.floor": floor})


def test_another_source_tells_the_session_of_its_ground_and_undo_does_not_forget_it() -> None:
    session = Session(small_source(), config=small_config().replace({"costs.floor": 0.0}))
    session.tick()
    session.configure({"costs.q_track": 7.0})
    for ground, floor in ((-10.0, -10.0), (None, OFF), (3.0, 3.0)):
        session.set_source(source_above(ground)).result()
        assert session.frame is not None
        assert session.frame.config.costs.floor == session.config.costs.floor == floor, "from the first plan on"
    assert session.undo() == small_config().replace({"costs.floor": 3.0})
    session.close()


def test_a_source_that_fails_leaves_the_floor() -> None:
    session = Session(small_source(), config=small_config().replace({"costs.floor": 0.0}))
    session.tick()
    before = session.configure({"costs.q_track": 7.0})
    assert session.set_source(source_above(-10.0, Blind)).exception() is not None
    assert session.config == before
    assert session.tick().config == before
    assert session.undo().costs.floor == 0.0
    session.close()


@pytest.mark.parametrize("floor", [0.7, OFF], ids=["higher", "off"])
def test_a_floor_of_the_users_own_stays_in_another_world(floor: float) -> None:
    session = Session(small_source(), config=small_config().replace({"costs.floor": floor}))
    session.tick()
    session.set_source(source_above(-10.0)).result()
    assert session.config.costs.floor == floor
    session.close()
