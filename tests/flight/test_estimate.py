"""Errors of the state estimate: their statistics, and their independence from the true state."""

import numpy as np
import pytest
import warp as wp

from aero_viz.flight import FlightRules, Simulator, StateNoise, VehicleModel
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

HOVER = (9.81, 0.0, 0.0, 0.0)
LIDAR = LidarModel("small", points_per_sweep=100, range_noise=0.0, dropout=0.0, elevation_min=-90.0)
RULES = FlightRules(stall_time=1e9, time_limit=1e9)


def shell() -> World:
    """Return a world of walls 6 m around (0, 0, 2)."""
    faces = [[s * 6.5 * (k == i) for k in range(3)] for i in range(3) for s in (-1, 1)]
    boxes = [[*np.add(c, [0, 0, 2]), *[1.0 if v else 14.0 for v in c], 0.0] for c in faces]
    return World("shell", np.array([0.0, 0.0, 2.0]), np.array([5.0, 0.0, 2.0]), boxes=np.array(boxes))


def simulate(noise, seeds) -> Simulator:
    model = VehicleModel()
    return Simulator([shell()] * len(seeds), lidar=LIDAR, vehicle=model, rules=RULES, seeds=seeds, noise=noise)


def rotation_vectors(quaternions, reference):
    """Return rotation vectors in body axes from `reference` to quaternions w, x, y, z [.., 4]; level attitudes only."""
    sign = np.sign(np.sum(quaternions * reference, axis=-1, keepdims=True))
    return 2.0 * sign * quaternions[..., 1:]  # small angles


def errors(simulator, ticks):
    """Return the errors of position, velocity and attitude of hovering drones, each [ticks + 1, B, 3]."""
    commands = wp.array([[HOVER]] * len(simulator.outcomes()), dtype=wp.vec4)
    rows = []
    for tick in range(ticks + 1):
        if tick:
            simulator.advance(commands)
        e, v = simulator.estimate, simulator.vehicle
        rows.append(
            (
                e.position.numpy() - v.position.numpy(),
                e.velocity.numpy() - v.velocity.numpy(),
                rotation_vectors(e.quaternion.numpy(), v.quaternion.numpy()),
            )
        )
    return [np.array(column, dtype=float) for column in zip(*rows, strict=True)]


def test_spread_and_correlation_are_those_of_the_first_order_process():
    noise = StateNoise(position=0.1, velocity=0.2, attitude=2.0, correlation_time=0.2)
    found = errors(simulate(noise, range(300)), 20)
    for error, sigma in zip(found, (0.1, 0.2, np.radians(2.0)), strict=True):
        flat = error.reshape(len(error), -1)  # 900 independent processes
        for k in (0, 5, 20):  # stationary from the first tick on
            assert flat[k].std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * 900))
        for lag in (1, 10):
            measured = np.corrcoef(flat[5], flat[5 + lag])[0, 1]
            expected = np.exp(-lag * 0.02 / 0.2)
            assert measured == pytest.approx(expected, abs=4 * (1 - expected**2) / np.sqrt(900))
    axes = found[0][3].T
    assert np.abs(np.corrcoef(axes)[~np.eye(3, dtype=bool)]).max() < 4 / np.sqrt(300)


def test_attitude_stays_a_unit_quaternion():
    simulator = simulate(StateNoise(attitude=20.0), range(50))
    np.testing.assert_allclose(np.linalg.norm(simulator.estimate.quaternion.numpy(), axis=1), 1.0, atol=1e-6)


def test_true_states_do_not_depend_on_the_noise():
    paths = []
    for noise in (None, StateNoise(position=0.3, velocity=0.3, attitude=5.0)):
        simulator = simulate(noise, [3])
        commands = wp.array([[(11.0, 0.5, 0.2, 0.1)]], dtype=wp.vec4)
        for _ in range(20):
            simulator.advance(commands)
        paths.append(simulator.vehicle.position.numpy())
    np.testing.assert_array_equal(*paths)


def test_without_noise_the_estimate_is_the_true_state():
    simulator = simulate(None, [0])
    assert simulator.estimate.position is simulator.vehicle.position and simulator.estimate.state() == []


def test_an_error_depends_on_seed_and_tick_not_on_the_batch():
    noise = StateNoise(position=0.1, attitude=1.0)
    together, alone = errors(simulate(noise, [4, 5, 6]), 6), errors(simulate(noise, [5]), 6)
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a[:, 1], b[:, 0])
    assert not np.array_equal(together[0][:, 0], together[0][:, 1])


def test_sweeps_are_placed_in_the_estimated_frame():
    noise = StateNoise(position=0.5, correlation_time=1e6)  # one constant offset
    simulator, exact = (simulate(n, [2]) for n in (noise, None))
    for s in (simulator, exact):
        s.measure_sweep(-1)
    offset = simulator.estimate.position.numpy()[0] - simulator.vehicle.position.numpy()[0]
    assert np.linalg.norm(offset) > 0.1
    np.testing.assert_allclose(simulator.lidar.points.numpy() - exact.lidar.points.numpy(), [[offset] * 100], atol=1e-5)


def test_restored_errors_continue():
    simulator = simulate(StateNoise(position=0.1, velocity=0.1, attitude=1.0), [7])
    errors(simulator, 5)
    checkpoint = simulator.checkpoint()
    first = errors(simulator, 6)
    simulator.restore(checkpoint)
    for a, b in zip(first, errors(simulator, 6), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("changes", [{"position": -0.1}, {"attitude": float("inf")}, {"correlation_time": 0.0}])
def test_invalid_noise_is_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        StateNoise(**changes)
