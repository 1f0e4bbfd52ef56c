"""Candidates that fly along beside dynamic obstacles are refused, compared with a NumPy reference."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from aero_planner.device.params import Params, pack
from aero_planner.device.records import bundle
from aero_planner.stages.moving_obstacles.giving_way import MovingObstacles, gives_way
from tests.planner.cases import config_of

Array = NDArray[np.float64]
DURATION = 25 * config_of().sampling.dt
PILLAR = (np.array([0.5, -1.2]), np.array([0.0, 2.0]), 0.3)
"""Position, velocity and radius of an obstacle beside the start, which crosses the way to the goal."""
GOAL = np.array([20.0, 0.0, 2.0])


_fields = {"__annotations__": {"moving_obstacles": MovingObstacles}, "__module__": __name__}
Views: Any = wp.struct(type("Views", (), _fields))
_judge: Any = gives_way


@wp.kernel
def judge(admissible: int, views: Views, params: wp.array(dtype=Params), result: wp.array(dtype=int)):
    m = wp.tid()
    result[m] = _judge(0, m, admissible, views, params[0])


def judged(
    ends: Array, obstacles: list[tuple[Array, Array, float]], device: str, *, goal: Array = GOAL, admissible: int = 1
) -> NDArray[np.bool_]:
    """Return which of the candidates with these ends [m], [M, 3], may be flown. All start at (0, 0, 2)."""
    start, share = np.array([0.0, 0.0, 2.0]), np.linspace(0.0, 1.0, 26)[:, None]
    positions = start + share * (ends[:, None] - start)
    padded = obstacles or [(np.zeros(2), np.zeros(2), 0.0)]
    places, velocities, radii = (np.array(values, np.float32)[None] for values in zip(*padded, strict=True))
    views = Views()
    views.moving_obstacles = bundle(
        MovingObstacles,
        dynamic_count=wp.array([len(obstacles)], dtype=int, device=device),
        dynamic_position=wp.array(places, dtype=wp.vec2, device=device),
        dynamic_velocity=wp.array(velocities, dtype=wp.vec2, device=device),
        dynamic_radius=wp.array(radii, dtype=float, device=device),
        positions=wp.array(positions[None].astype(np.float32), dtype=wp.vec3, device=device),
        goal_position=wp.array(goal[None].astype(np.float32), dtype=wp.vec3, device=device),
    )
    params = wp.array(np.array([pack(config_of())]), dtype=Params, device=device)
    result = wp.zeros(len(ends), dtype=int, device=device)
    wp.launch(judge, len(ends), inputs=[admissible, views, params], outputs=[result], device=device)
    return result.numpy() != 0


def expected(end: Array, obstacles: list[tuple[Array, Array, float]]) -> bool:
    """Return False for one that stays beside an obstacle, flies about its way, and hardly comes nearer to the goal."""
    start = np.array([0.0, 0.0, 2.0])
    way = (end - start)[:2]
    if np.linalg.norm(GOAL - start) - np.linalg.norm(GOAL - end) >= 0.5 * np.linalg.norm(way):
        return True
    for place, velocity, radius in obstacles:
        before, after = place - start[:2], place + DURATION * velocity - end[:2]
        is_beside = max(np.linalg.norm(before), np.linalg.norm(after)) < 4.0 + radius
        if is_beside and np.linalg.norm(way - DURATION * velocity) < 0.5 * DURATION * np.linalg.norm(velocity):
            return False
    return True


def test_the_judgement_is_that_of_the_reference(device: str):
    rng = np.random.default_rng(5)
    ends = np.column_stack((rng.uniform(-2.0, 5.0, 300), rng.uniform(-5.0, 5.0, 300), rng.uniform(1.0, 3.0, 300)))
    obstacles = [PILLAR, (np.array([-1.0, 1.5]), np.array([0.4, -1.5]), 0.5)]
    found = judged(ends, obstacles, device)
    np.testing.assert_array_equal(found, [expected(end, obstacles) for end in ends])
    assert 10 < np.sum(~found) < 150


@pytest.mark.parametrize(
    ("end", "may"),
    [
        ((0.0, 2.0 * DURATION), False),  # along beside it
        ((0.2, 1.5 * DURATION), False),  # a little slower
        ((2.0, -1.0), True),  # past behind it
        ((-0.3, 0.1), True),  # almost standing
        ((2.0 * DURATION, 1.0), True),  # toward the goal
        ((0.0, -2.0 * DURATION), True),  # the other way
    ],
)
def test_who_flies_along_beside_an_obstacle_may_not(device: str, end: tuple[float, float], may: bool):
    assert judged(np.array([[*end, 2.0]]), [PILLAR], device).tolist() == [may]


def test_an_obstacle_on_its_way_to_the_goal_is_accompanied(device: str):
    end = np.array([[0.0, 2.0 * DURATION, 2.0]])
    assert judged(end, [PILLAR], device, goal=np.array([0.0, 20.0, 2.0])).all()
    assert judged(end, [], device).all()


def test_what_is_refused_otherwise_stays_refused(device: str):
    assert not judged(np.array([[2.0, -1.0, 2.0]]), [PILLAR], device, admissible=0).any()
