"""Repeating the ticks of a session on a separate source."""

import numpy as np

from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session
from aero_viz.session.repeat import repeat


def test_a_flight_with_changes_and_a_fork_is_repeated_bit_for_bit():
    session = Session(FlightSource(scene("forest", seed=3), seed=3), seed=3)
    try:
        for _ in range(12):
            session.tick()
        session.seek(0.1)
        session.configure({"costs.q_position": 9.0})
        session.set_goal([15.0, 2.0, 2.0])
        session.seek(0.1)
        frames = {frame.time: frame for frame in [session.tick() for _ in range(6)]}
        session.configure({"costs.q_track": 3.0})
        assert session.frame is not None
        frames[session.frame.time] = session.frame  # planned once more
        frames |= {frame.time: frame for frame in [session.tick() for _ in range(6)]}
        twin = FlightSource.twin(session.source)
        again = list(repeat(twin, session.flown().result(), device="cpu", seed=3))
        assert len(again) == 18 and [frame.config.costs.q_track for frame in again][-7:] == [3.0] * 7
        for frame in again[6:]:
            original = frames[frame.time]
            assert np.array_equal(frame.plan.command, original.plan.command)
            assert np.array_equal(frame.observation.points, original.observation.points)
            assert np.array_equal(frame.observation.goal.position, original.observation.goal.position)
            assert np.array_equal(frame.trail, original.trail)
    finally:
        session.close()
