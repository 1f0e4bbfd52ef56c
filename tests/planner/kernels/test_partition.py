import numpy as np
import pytest

from aero_planner import Planner
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, random_case, random_quaternion

SEEDS = range(4)


def away_from_borders(case: Case, rows: int, columns: int) -> Case:
    """Remove points so near to the border of a cell that float32 may put them on the other side.

    At coordinates of 30 m float32 resolves 2e-6 m; at the nearest range of 0.6 m that is 3e-6 rad or 1e-4 fine cells.
    """
    directions = (case.points - case.position) @ reference.rotation(reference.unit(case.quaternion))
    case.points = case.points[reference.cell_indices(directions, rows, columns)[2] > 1e-3]
    return case


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("pool", [6, 3])
def test_fine_ranges_and_filtered_points(device: str, seed: int, pool: int):
    rows, columns = 10 * pool, 20 * pool
    config = config_of(partition__fine_cells=pool, unseen_space__continuation=0.0)
    case = away_from_borders(random_case(seed, count=4000), rows, columns)
    plan = case.plan(Planner(config, device=device))
    part = config.partition
    fine, nearest = reference.partition(
        case.points.astype(np.float64), case.position, case.quaternion, range_max=part.range_max,
        range_min=part.range_min, rows=rows, columns=columns,
    )  # fmt: skip
    assert plan.fine_range.shape == (rows, columns)
    # One subtraction at 30 m and one root: a few units of 2e-6 m.
    np.testing.assert_allclose(plan.fine_range, fine, atol=1e-5)
    np.testing.assert_array_equal(kept_points(plan), case.points[nearest[nearest >= 0]])


@pytest.mark.parametrize("seed", SEEDS)
def test_coarse_cells_keep_the_safest_direction_nearest_to_the_one_refined(device: str, seed: int):
    config = config_of(unseen_space__continuation=0.0)
    # Few points leave many cells tied at range_max.
    case = random_case(seed, count=150)
    plan = case.plan(Planner(config, device=device))
    anchors = reference.anchor_directions(case.position, case.velocity, case.goal, config)
    anchors = anchors @ reference.rotation(reference.unit(case.quaternion))
    row_of, column_of, border = reference.cell_indices(anchors, 10, 20)
    centers = reference.cell_centers(10, 20)
    for row in range(10):
        for column in range(20):
            greatest, tied = reference.safe_cells(plan.fine_range, config.partition.fine_cells, row, column)
            assert plan.safe_range[row, column] == np.float32(greatest)
            inside = np.flatnonzero((row_of == row) & (column_of == column))
            if np.any(border < 1e-4):
                continue  # an anchor that float32 may put into the neighbouring cell
            toward = anchors[inside[0]] if len(inside) else centers[row, column]
            chosen = plan.safe_direction[row, column]
            # The kernel calls cosines within 1e-6 equal, and float32 knows a cosine to 1e-7.
            assert chosen @ toward >= (tied @ toward).max() - 2e-6
            assert np.abs(tied - chosen).max(axis=1).min() < 1e-6


def test_the_maximum_wins_over_the_nearest_direction(device: str):
    case = random_case(0, count=0)
    case.position, case.quaternion, case.goal = np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([20.0, 0.5, 0.5])
    directions = reference.cell_centers(60, 120)[30:36, 60:66].reshape(-1, 3)
    ranges = np.full(36, 4.0)
    ranges[35] = 6.0  # the corner farthest from the goal's direction
    case.points = (directions * ranges[:, None]).astype(np.float32)
    config = config_of(partition__fine_cells=6, unseen_space__continuation=0.0)
    plan = case.plan(Planner(config, device=device))
    assert plan.safe_range[5, 10] == pytest.approx(6.0, abs=1e-5)
    np.testing.assert_allclose(plan.safe_direction[5, 10], directions[35], atol=1e-6)
    # The middle anchor lies in that cell.
    np.testing.assert_allclose(plan.anchors[7], directions[35] * np.linalg.norm(plan.anchors[7]), atol=1e-5)


@pytest.mark.parametrize("seed", SEEDS)
def test_empty_cloud(device: str, seed: int):
    case = random_case(seed, count=0)
    plan = case.plan(Planner(config_of(unseen_space__continuation=0.0), device=device))
    assert kept_points(plan).shape == (0, 3) and plan.dropped_points == 0
    assert (plan.fine_range == 10.0).all() and (plan.safe_range == 10.0).all()
    assert (plan.collision_cost == 0.0).all()
    assert (plan.clearance == np.float32(0.55)).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_points_that_are_not_finite_are_dropped_and_counted(device: str, seed: int):
    rng, case = np.random.default_rng(seed), random_case(seed)
    clean = case.plan(Planner(config_of(unseen_space__continuation=0.0), device=device))
    bad = np.full((40, 3), np.nan, np.float32)
    bad[10:] = case.points[rng.integers(len(case.points), size=30)]
    bad[np.arange(10, 40), rng.integers(3, size=30)] = rng.choice([np.nan, np.inf, -np.inf], 30)
    # Finite, but their squared range is not.
    huge = np.full((5, 3), 3e38, np.float32)
    case.points = np.concatenate((bad, case.points, huge))
    dirty = case.plan(Planner(config_of(unseen_space__continuation=0.0), device=device))
    assert (clean.dropped_points, dirty.dropped_points) == (0, 40)
    np.testing.assert_array_equal(clean.fine_range, dirty.fine_range)
    np.testing.assert_array_equal(clean.filtered_points, dirty.filtered_points)
    np.testing.assert_array_equal(clean.controls, dirty.controls)


def test_points_outside_range_min_and_range_max_are_ignored(device: str):
    # Axis-aligned, so that the ranges are exact.
    points = np.array([[2.0, 0, 0], [0, 8.0, 0], [-1.75, 0, 0], [0, -8.25, 0]], np.float32)
    config = config_of(partition__range_min=2.0, partition__range_max=8.0, vehicle__speed_limit=5.0)
    case = random_case(0, count=0)
    case.position, case.quaternion, case.points = np.zeros(3), np.array([1.0, 0, 0, 0]), points
    plan = case.plan(Planner(config, device=device))
    assert {tuple(p) for p in kept_points(plan)} == {(2.0, 0.0, 0.0), (0.0, 8.0, 0.0)}


@pytest.mark.parametrize(("speed_limit", "expected"), [(7.0, 6.0), (9.0, 9.0), (20.0, 20.0)])
def test_a_fast_drone_sees_farther(device: str, speed_limit: float, expected: float):
    """Twice its look-ahead distance; a longer look-ahead by itself changes nothing."""
    config = config_of(partition__range_max=6.0, vehicle__speed_limit=speed_limit, anchors__lookahead=12.0)
    config = config.replace({"anchors.lookahead_time": 0.5 if speed_limit > 7.0 else 0.0})
    plan = random_case(0, count=0).plan(Planner(config, device=device))
    assert config.farthest_range == expected and (plan.fine_range == expected).all()


def test_equal_ranges_take_the_first_point(device: str):
    # Powers of two: both squared ranges are the same number, in whatever order they are summed.
    a, b = [4.0, 2**-4, 2**-5], [4.0, 2**-5, 2**-4]
    case = random_case(0, count=0)
    case.position, case.quaternion = np.zeros(3), np.array([1.0, 0, 0, 0])
    for points in ([a, b], [b, a]):
        case.points = np.array(points, np.float32)
        plan = case.plan(Planner(config_of(unseen_space__continuation=0.0), device=device))
        np.testing.assert_array_equal(kept_points(plan), [points[0]])


def test_points_on_the_poles_and_the_seam(device: str):
    points = np.array([[0, 0, 3], [0, 0, -3], [-3, 0, 0.01], [-3, -0.0, 0.01]], np.float32)
    case = random_case(0, count=0)
    case.position, case.quaternion, case.points = np.zeros(3), np.array([1.0, 0, 0, 0]), points
    config = config_of(partition__fine_cells=6, unseen_space__continuation=0.0)
    plan = case.plan(Planner(config, device=device))
    occupied = np.argwhere(plan.fine_range < 10.0)
    assert {row for row, _ in occupied} == {0, 30, 59}
    # Azimuth -180 deg and +180 deg are the same cell.
    assert [column for row, column in occupied if row == 30] == [0]


@pytest.mark.parametrize("seed", SEEDS)
def test_partition_turns_with_the_body(device: str, seed: int):
    """Rotating cloud and attitude together leaves the partition unchanged."""
    rng, case = np.random.default_rng(seed), random_case(seed)
    case.position = np.zeros(3)
    case.points = random_case(seed).points - random_case(seed).position.astype(np.float32)
    case = away_from_borders(case, 60, 120)
    planner = Planner(config_of(unseen_space__continuation=0.0), device=device)
    before = case.plan(planner)
    turn = random_quaternion(rng)
    R = reference.rotation(reference.unit(turn))
    case.points = (case.points @ R.T).astype(np.float32)
    case.quaternion = reference.quat_multiply(reference.unit(turn), case.quaternion)
    np.testing.assert_allclose(case.plan(planner).fine_range, before.fine_range, atol=1e-5)
