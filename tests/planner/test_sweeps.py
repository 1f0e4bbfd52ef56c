"""Sweeps that the planner remembers give the same plans as the joined cloud, bit for bit."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from aero_planner import Goal, Planner, PlannerConfig, Sweeps, VehicleState, registry
from tests.planner import cases
from tests.planner.cases import assert_same, batch_of, random_case

Cloud = NDArray[np.float32]
STATE = VehicleState(np.zeros(3), np.zeros(3), (1.0, 0.0, 0.0, 0.0))
GOAL = Goal((20.0, 0.0, 0.0))
STAGES = ", ".join(name for name in registry.names("stages") if name != "stray_points")


def config_of(preset: str = "default", **changes: Any) -> PlannerConfig:
    """Return a small configuration that keeps stray points, which a joined cloud has as well."""
    return cases.config_of(preset, **({"stages__active": STAGES} if preset == "default" else {}) | changes)


def random_sweep(rng: np.random.Generator, position: NDArray[np.float64], count: int = 300) -> Cloud:
    """Return points at 0.2 to 50 m, some of them without return, infinite, or a copy of others."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = (position + direction * rng.uniform(0.2, rng.choice([8.0, 50.0]), (count, 1))).astype(np.float32)
    points[rng.random(count) < 0.3] = np.nan
    points[rng.random(count) < 0.02, 1] = np.inf
    points[rng.random(count) < 0.02] = 3e38
    points[: count // 10] = points[count // 2 : count // 2 + count // 10]
    return points


@pytest.mark.parametrize("threads", [1, 3])
def test_plans_equal_those_of_the_joined_cloud(device: str, threads: int):
    rng = np.random.default_rng(threads)
    ring, joined = (Planner(config_of(), device=device, seed=1, threads=threads) for _ in range(2))
    sweeps, position = Sweeps(), np.zeros(3)
    for tick in range(40):
        for _ in range(int(rng.integers(0, 3))):
            count = int(rng.choice([0, 40, 300, 900 if tick > 20 else 300]))
            sweeps = sweeps.add(random_sweep(rng, position, count), limit=6)
        position = position + rng.normal(size=3) * (8.0 if tick % 7 == 0 else 0.3)
        state = VehicleState(position, rng.normal(size=3), random_case(tick).quaternion)
        assert_same(ring.plan(state, GOAL, sweeps), joined.plan(state, GOAL, sweeps.points))


def test_equal_ranges_take_the_point_of_the_oldest_sweep(device: str):
    # Both squared ranges are the same number, in whatever order they are summed.
    a, b = [4.0, 2**-4, 2**-5], [4.0, 2**-5, 2**-4]
    planner = Planner(config_of(unseen_space__view_age=0.0), device=device)
    for first, second in ((a, b), (b, a)):
        sweeps = Sweeps([np.full((50, 3), np.nan, np.float32)] * 3)
        for points in (first, second, first, second):
            sweeps = sweeps.add(np.array([points], np.float32), limit=3)
            oldest = next(sweep for sweep in sweeps if np.isfinite(sweep).all())
            np.testing.assert_array_equal(planner.plan(STATE, GOAL, sweeps).filtered_points, oldest)


def test_a_larger_range_reaches_points_that_were_out_of_range(device: str):
    planner = Planner(config_of(unseen_space__view_age=0.0), device=device)
    sweeps = Sweeps([np.array([[14.0, 0.0, 0.0], [0.0, 3.0, 0.0]], np.float32)])
    assert len(planner.plan(STATE, GOAL, sweeps).filtered_points) == 1
    planner.configure(planner.config.replace({"partition.range_max": 15.0}))
    assert len(planner.plan(STATE, GOAL, sweeps).filtered_points) == 2


@pytest.mark.parametrize("whole", [0, 1, 3])
def test_older_sweeps_are_thinned_as_in_the_joined_cloud(device: str, whole: int):
    rng = np.random.default_rng(whole)
    ring, joined = (Planner(config_of(), device=device, seed=1) for _ in range(2))
    sweeps, history = Sweeps(whole=whole), []
    for tick in range(30):
        # Sometimes the sweeps go back in time, or begin again.
        sweeps = history[-4] if tick % 9 == 8 else sweeps.add(random_sweep(rng, np.zeros(3)), limit=6)
        history.append(sweeps)
        state = VehicleState(rng.normal(size=3), rng.normal(size=3), random_case(tick).quaternion)
        plan, expected = ring.plan(state, GOAL, sweeps), joined.plan(state, GOAL, sweeps.points)
        np.testing.assert_array_equal(plan.filtered_points, expected.filtered_points)
        np.testing.assert_array_equal(plan.controls, expected.controls)
    assert sweeps.thinned == 6 - whole
    assert 0.1 < len(Sweeps(sweeps, whole=0).points) / sweeps.point_count < 0.3


def test_a_sweep_in_the_memory_of_an_earlier_one_is_thinned_by_itself():
    rng = np.random.default_rng(0)
    for _ in range(50):
        sweeps = Sweeps([random_sweep(rng, np.zeros(3))], whole=0)
        kept, all_points = sweeps.points, next(iter(sweeps))
        assert len(kept) and np.isin(kept.view(np.uint32), all_points.view(np.uint32)).all()
        del sweeps, kept, all_points


def test_any_sweeps_may_follow_any_others(device: str):
    """A session that goes back in time returns to earlier sweeps."""
    rng = np.random.default_rng(0)
    ring = Planner(config_of(), device=device)
    pool = list(Sweeps([random_sweep(rng, np.zeros(3), int(n)) for n in rng.integers(1, 400, 12)]))
    for _ in range(30):
        first = int(rng.integers(0, 12))
        chosen = pool[first : first + int(rng.integers(0, 8))]
        if rng.random() < 0.3:
            chosen = [pool[i] for i in rng.permutation(12)[:7]]
        fresh = Planner(ring.config, device=device)
        ring.reset()
        sweeps = Sweeps(chosen)
        assert_same(ring.plan(STATE, GOAL, sweeps), fresh.plan(STATE, GOAL, sweeps.points))
        fresh.close()


def test_sweeps_and_joined_clouds_may_alternate(device: str):
    case, planner = random_case(0), Planner(config_of(), device=device)
    expected = case.plan(planner)
    halves = Sweeps(np.array_split(case.points, 2))
    for points in (halves, case.points, halves):
        planner.reset()
        assert_same(expected, planner.plan(case.state, Goal(case.goal), points))
    planner.reset()
    planner.configure(config_of("paper"))
    assert_same(
        planner.plan(case.state, Goal(case.goal), halves), case.plan(Planner(config_of("paper"), device=device))
    )


def test_a_changed_array_is_a_new_sweep(device: str):
    """Only read-only arrays are recognised: others may have been overwritten."""
    planner = Planner(config_of(unseen_space__view_age=0.0), device=device)
    points = np.array([[5.0, 0.0, 0.0]], np.float32)
    planner.plan(STATE, GOAL, Sweeps([points]))
    points[:] = [[3.0, 0.0, 0.0]]
    np.testing.assert_array_equal(planner.plan(STATE, GOAL, Sweeps([points])).filtered_points, points)


def test_sweeps_are_joined_in_order():
    a, b = np.zeros((2, 3), np.float32), np.ones((1, 3))
    sweeps = Sweeps([a]).add(b, limit=2)  # type: ignore[arg-type]
    np.testing.assert_array_equal(sweeps.points, np.concatenate((a, b)))
    assert sweeps.points is sweeps.points and not sweeps.points.flags.writeable
    assert (len(sweeps), sweeps.point_count) == (2, 3)
    np.testing.assert_array_equal(sweeps.add(a, limit=2).points, np.concatenate((b, a)))
    assert Sweeps().points.shape == (0, 3)


@pytest.mark.parametrize("points", [np.zeros(3), np.zeros((3, 2)), np.array([["a", "b", "c"]])])
def test_a_sweep_of_another_shape_or_type_is_refused(points: np.ndarray):
    with pytest.raises(ValueError, match=r"must be \(n, 3\) numbers"):
        Sweeps([points])


@pytest.mark.parametrize("remembered", [None, [3, 2]])
def test_a_batch_stores_sweeps_on_the_device(device: str, remembered: list[int] | None):
    rng = np.random.default_rng(3)
    cases = [random_case(seed) for seed in (1, 2)]
    state, goal, _ = batch_of(cases)
    stored, joined = (Planner(config_of(), device=device, batch=2) for _ in range(2))
    joined.plan(state, goal, [case.points for case in cases])
    stored.plan(state, goal, [case.points for case in cases])
    places = np.full((3, 2, 200, 3), np.nan, np.float32)
    stored.reserve_sweeps(3, 600, remembered=remembered)
    for tick in range(5):
        places[tick % 3] = [random_sweep(rng, case.position, 200) for case in cases]
        stored.store_sweep(tick % 3, wp.array(places[tick % 3], dtype=wp.vec3, device=device))
        stored.launch()
        if remembered is not None:
            places[(tick - 2) % 3, 1] = np.nan  # the second drone's oldest sweep
        plan = joined.plan(state, goal, list(np.concatenate(places, axis=1)))
        np.testing.assert_array_equal(stored.outputs.fine_range.numpy(), plan.fine_range.reshape(2, -1))
        np.testing.assert_array_equal(stored.command.numpy(), plan.command)


def test_wrong_uses_are_refused(device: str):
    case = random_case(0)
    batch = Planner(config_of(), device=device, batch=2)
    with pytest.raises(ValueError, match="sweeps were given for a batch"):
        batch.plan(*batch_of([case, case])[:2], Sweeps([case.points]))
    sweep = wp.zeros((2, 5), dtype=wp.vec3, device=device)
    with pytest.raises(ValueError, match="call `reserve_sweeps` first"):
        batch.store_sweep(0, sweep)
    batch.reserve_sweeps(2, 10)
    for index, points in ((2, sweep), (-1, sweep), (0, sweep[:1]), (1, wp.zeros((2, 6), dtype=wp.vec3, device=device))):
        with pytest.raises(ValueError, match="does not fit"):
            batch.store_sweep(index, points)  # type: ignore[arg-type]
