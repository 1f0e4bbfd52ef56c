"""A few flights with faults drawn by a seed, what is drawn, and that the judge sees what is wrong."""

import dataclasses

import numpy as np
import pytest

from aero_viz.rig import FAULT_KINDS, Event, Trajectory
from tests.rig.fault_flights import braked_phases, broken_promises, documented_endings, draw, ending, fly
from tests.rig.results import RESULT


def test_a_seed_draws_two_or_three_different_faults_and_every_kind_appears():
    flights = [draw(seed) for seed in range(200)]
    for flight in flights:
        kinds = [fault.kind for fault in flight.faults]
        assert len(kinds) == len(set(kinds)) in (2, 3) and 2.0 <= flight.speed <= 7.0
        assert flight.world.distance(np.array([flight.world.start, flight.world.goal]), 0.0).min() > 1.0
    assert {fault.kind for flight in flights for fault in flight.faults} == set(FAULT_KINDS)
    assert str(draw(7)) == str(flights[7])


# 2001: the battery is low, and the node starts again in the air. 1020: half of the packets, no points, a frozen state.
@pytest.mark.parametrize("seed", [2001, 1020])
def test_a_flight_with_faults_keeps_the_promises_of_the_document(seed: int):
    flight = draw(seed)
    result = fly(flight)
    assert broken_promises(flight, result) == []
    assert ending(result) in documented_endings()


def judged(heights: np.ndarray, **changes) -> list[str]:
    """Return what is wrong with a flight that brakes after 1 s at these heights [m], shape [n], and then ends."""
    count = len(heights)
    times = np.linspace(0.0, 2.0, count)
    positions = np.stack([np.full(count, -20.0), np.zeros(count), heights], axis=1)
    events = [Event(1.0, "fault: kill-sensor for 100 s"), Event(1.0, "node: FLYING -> BRAKING: no points")]
    events.append(Event(1.9, "node: HOLDING -> HANDED_BACK: no safe way to continue was found in time"))
    trajectory = Trajectory(times, positions, np.zeros((count, 3)), np.ones(count, dtype=bool))
    result = dataclasses.replace(RESULT, arrived=False, reason="held", events=events, trajectory=trajectory)
    result = dataclasses.replace(result, **changes)
    assert braked_phases(result)[0][0] == 1.0
    return broken_promises(draw(0), result)


def test_the_judge_sees_a_loss_of_height_a_collision_and_an_ending_that_is_not_documented():
    level = np.full(201, 2.0)
    assert judged(level) == []
    (lost,) = judged(np.where(np.linspace(0.0, 2.0, 201) > 1.5, 1.4, 2.0))
    assert lost == "loses 0.60 m of height"
    assert judged(level, reason="collision") == ["collision"]  # it was at rest, 20 m from the first post
    (undocumented,) = judged(level, reason="timeout")
    assert undocumented.startswith("ends by timeout")
    assert judged(level, violations=["SET_MODE"], log=["a plan failed"]) == ["requests SET_MODE", "a plan failed"]
