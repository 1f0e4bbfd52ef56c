"""The seed of a flight in a session: the flight equals the one on the command line, bit for bit."""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source
from aero_viz.flight import FlightBatch, FlightRules, fly
from aero_viz.flight.known_drone import config_for_flight, config_for_next_flight
from aero_viz.scenes import scene
from aero_viz.session import Session

SEED, TICKS = 7, 30


@pytest.fixture(scope="module")
def flown():
    """Positions of `aero-viz fly pillars --seed 7` [m], shape [TICKS, 3]."""
    path = []
    recorder: object = SimpleNamespace(write=lambda _: None, write_pose=lambda _, state: path.append(state.position))
    rules = FlightRules(time_limit=0.02 * TICKS)
    fly(scene("pillars", seed=SEED), seed=SEED, rules=rules, recorder=contextlib.nullcontext(recorder))  # type: ignore
    return np.array(path[:TICKS])


@pytest.mark.parametrize("first", [SEED, SEED + 1])
def test_a_flight_on_the_page_is_that_of_the_command_line(first, flown):
    source = open_source("pillars", seed=first)
    session = Session(source, config=config_for_flight(PlannerConfig(), source.info), seed=first)
    with contextlib.closing(session):
        frame = session.tick()
        if first != SEED:  # the seed is opened later
            session.step(3).result()
            source = open_source("pillars", seed=SEED)
            known = config_for_next_flight(session.config, before=session.source, after=source.info)
            session.set_source(source, seed=SEED).result()
            session.configure(known)
            frame = session.frame
        frames = [frame, *(session.tick() for _ in range(TICKS - 1))]
        assert np.array_equal([frame.observation.actual_state.position for frame in frames], flown)


def test_a_flight_in_a_batch_is_that_of_its_seed(flown):
    batch = FlightBatch([scene("pillars", seed=seed) for seed in (SEED - 1, SEED)], seed=SEED - 1)
    for expected in flown:
        assert np.array_equal(batch.simulator.vehicle.position.numpy()[1], expected)
        batch.step()
