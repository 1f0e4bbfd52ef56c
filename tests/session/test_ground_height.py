"""The height of the ground on its way from the source to the planner."""

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_viz.flight import FlightSource
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from aero_viz.session import Session
from aero_viz.session.source import Observation


class UnobservableSource(FlightSource):
    """A flight whose first observation fails."""

    def observe(self) -> Observation:
        raise ValueError("there is nothing to see.")


def source_above(
    ground: float | None, kind: type[FlightSource] = FlightSource, *, altitude: float = 2.0
) -> FlightSource:
    """Return a flight `altitude` [m] above flat ground at height `ground` [m], or above none."""
    height = 0.0 if ground is None else ground
    boxes = np.array([[5.0, 0.0, height - 0.5, 60.0, 60.0, 1.0, 0.0]])
    start = np.array([0.0, 0.0, height + altitude])
    world = World("valley", start, np.add(start, (12.0, 0.0, 0.0)), boxes=boxes[: 0 if ground is None else 1])
    return kind(world, lidar=LidarModel("sparse", points_per_sweep=2000))


def test_frames_carry_the_ground_height_of_their_source():
    session = Session(small_source(), config=small_config())
    config = session.config
    assert session.tick().observation.ground_height == 0.0
    for ground in (-10.0, None, 3.0):
        session.set_source(source_above(ground)).result()
        assert session.frame is not None
        assert session.frame.observation.ground_height == ground
        assert session.frame.config is config, "the configuration does not depend on the world"
    session.close()


@pytest.mark.parametrize("use_ground", [True, False])
def test_the_engine_passes_the_ground_height_to_the_planner(use_ground: bool):
    changes = {"costs.use_ground": use_ground, "candidates.prefer_safe": False}
    session = Session(source_above(-10.0, altitude=0.4), config=small_config().replace(changes))
    plan = session.tick().plan
    altitude = plan.positions[:, 1, 2] + 10.0
    assert (plan.clearance[:, 0] <= altitude + 1e-4).all() == use_ground
    session.close()


def test_a_source_that_fails_leaves_the_configuration():
    session = Session(small_source(), config=small_config())
    session.tick()
    before = session.configure({"costs.q_track": 7.0})
    assert session.set_source(source_above(-10.0, UnobservableSource)).exception() is not None
    assert session.config == before
    assert session.tick().config == before
    assert session.undo() == small_config()
    session.close()
