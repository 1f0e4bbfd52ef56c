"""The drift of an estimate in the clouds of a simulated Mid-360."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from aero_planner.onboard.cloud_drift import Drift, measure_drift
from aero_viz.catalog import load_world
from aero_viz.scenes import World
from tests.rig.hover import scan

PLACE = np.array([0.0, 0.0, 2.0])
SWEEPS, SPEED, TILT = 4, 0.4, 3.0
"""Sweeps of 0.1 s, speed of the error [m/s], error of the tilt [deg]."""


def drift_in(
    world: World, error: Callable[[int], tuple[float, float, float, float]], *, first: int = 0
) -> Drift | None:
    """Return the drift between two parts of hover of 0.2 s; `error` gives x, y [m], roll and pitch [deg] of a sweep."""
    sweeps = scan(world, PLACE, map(error, range(SWEEPS)), first=first)
    half = SWEEPS // 2
    return measure_drift(np.concatenate(sweeps[:half]), np.concatenate(sweeps[half:]), PLACE)


def exact(_: int) -> tuple[float, float, float, float]:
    """Return the errors of an exact estimate."""
    return 0.0, 0.0, 0.0, 0.0


@pytest.fixture(scope="module")
def forest() -> World:
    return load_world("forest", seed=0)


def test_an_exact_estimate_does_not_drift(forest: World):
    drift = drift_in(forest, exact)
    assert drift is not None and drift.angle < np.radians(0.2) and drift.shift < 0.03


def test_a_wrong_velocity_is_measured(forest: World):
    drift = drift_in(forest, lambda k: (0.1 * SPEED * k, 0.0, 0.0, 0.0))
    assert drift is not None and drift.angle < np.radians(0.2)
    np.testing.assert_allclose(drift.displacement, [0.2 * SPEED, 0.0, 0.0], atol=0.01)


def test_a_tilt_that_changes_is_measured(forest: World):
    drift = drift_in(forest, lambda k: (0.0, 0.0, TILT if k >= SWEEPS // 2 else 0.0, 0.0))
    assert drift is not None and np.degrees(drift.angle) == pytest.approx(TILT, abs=0.3) and drift.shift < 0.05


def test_noise_of_the_attitude_is_noticed(forest: World):
    random = np.random.default_rng(0)
    found = [drift_in(forest, lambda _: (0.0, 0.0, *random.normal(scale=TILT, size=2))) for _ in range(3)]
    angles = [np.degrees(drift.angle) for drift in found if drift is not None]
    assert len(angles) == 3 and np.sqrt(np.mean(np.square(angles))) > 1.5  # above the node's default limit


def test_pillars_that_move_are_not_taken_for_drift():
    seconds = [drift_in(load_world("moving", seed=7), exact, first=SWEEPS * k) for k in range(20)]
    assert sum(drift is not None for drift in seconds) <= 2  # three in a row are needed for an alarm


def test_drift_is_measured_where_few_pillars_move(forest: World):
    motion = np.zeros((len(forest.cylinders), 3))
    nearest = np.argsort(np.linalg.norm(forest.cylinders[:, :2] - PLACE[:2], axis=1))[:2]
    motion[nearest] = 1.0, 0.0, 5.0
    drift = drift_in(replace(forest, motion=motion), lambda k: (0.0, 0.1 * SPEED * k, 0.0, 0.0))
    assert drift is not None and drift.displacement[1] == pytest.approx(0.2 * SPEED, abs=0.02)


def test_without_structure_nothing_is_measured():
    empty = World("empty", PLACE, np.array([5.0, 0, 2]))
    assert drift_in(empty, exact) is None
