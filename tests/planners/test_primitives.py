"""The motion-primitive planner."""

import numpy as np
from small_source import small_source

from aero_planner import VehicleState
from aero_viz.planners.primitives import PrimitiveConfig, quintics
from aero_viz.session import Session


def test_quintics_meet_their_ends():
    state = VehicleState([1.0, 2.0, 3.0], [2.0, 0.0, -1.0], (1, 0, 0, 0), acceleration=[0.5, -1.0, 0.0])
    ends, speeds = np.array([[5.0, 1.0, 3.0], [1.5, 2.0, 2.0]]), np.array([[3.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    times = np.linspace(0.0, 1.6, 1601)
    positions, accelerations = quintics(state, ends, speeds, times)
    velocities = np.gradient(positions, times, axis=1)
    for values, first, last in (
        (positions, state.position, ends),
        (velocities, state.velocity, speeds),
        (accelerations, state.acceleration, np.zeros((2, 3))),
    ):
        np.testing.assert_allclose(values[:, 0], np.broadcast_to(np.asarray(first), (2, 3)), atol=0.02)
        np.testing.assert_allclose(values[:, -1], last, atol=0.02)
    np.testing.assert_allclose(np.gradient(velocities, times, axis=1)[:, 10:-10], accelerations[:, 10:-10], atol=0.05)


def test_a_flight_between_poles_arrives_and_is_repeated_bit_for_bit():
    session = Session(small_source(), config=PrimitiveConfig())
    frames = [session.tick()]
    while frames[-1].outcome is None:
        frames.append(session.tick())
    assert frames[-1].outcome == "arrived"
    middle = frames[len(frames) // 2]
    assert list(middle.plan.costs) == ["goal", "obstacles", "effort", "change"] and middle.plan.kinds[-1] == "brake"
    session.seek(middle.time).result()
    again = session.frame
    assert again is not None and np.array_equal(again.plan.positions, middle.plan.positions)
    assert np.array_equal(again.plan.command, middle.plan.command)
    session.close()
