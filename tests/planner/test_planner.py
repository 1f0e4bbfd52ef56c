import gc
import weakref
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus
from aero_planner.array_memory import allocate
from aero_planner.arrays import Sizes
from tests.planner import reference
from tests.planner.cases import PLAN_ARRAYS, Case, assert_same, batch_of, config_of, kept_points, random_case, shell


def assert_consistent(plan: Plan, case: Case, config: PlannerConfig) -> None:
    """Assert that the arrays of the best instance follow from its controls and its guide."""
    m = plan.best
    x = reference.roll_out(case.position, case.quaternion, case.velocity, plan.controls[m], config)
    np.testing.assert_allclose(plan.positions[m, 1:], x.p, atol=1e-4)
    np.testing.assert_allclose(plan.velocities[m, 1:], x.v, atol=1e-4)
    d_max = config.costs.distance_max
    np.testing.assert_allclose(plan.clearance[m], reference.clearance(x.p, kept_points(plan), d_max), atol=2e-4)
    np.testing.assert_allclose(plan.goal_cost[m], reference.J_goal(x, *case.full_goal(), config).sum(), rtol=2e-5)
    d = plan.clearance[m].astype(np.float64)
    np.testing.assert_allclose(plan.collision_cost[m], reference.J_col(d, config).sum(), rtol=1e-4)
    np.testing.assert_array_equal(plan.guides[m, 0], plan.positions[m, 0])
    np.testing.assert_allclose(plan.guides[m, -1], plan.anchors[m], atol=2e-4)
    np.testing.assert_array_equal(plan.command, plan.controls[m])


def test_shapes_and_types(device: str):
    plan = random_case(0).plan(Planner(config_of(), device=device), samples=True)
    M, N, K = 16, 25, 16
    shapes = {
        "fine_range": (80, 160), "safe_range": (10, 20), "safe_direction": (10, 20, 3), "initial_endpoints": (M, 3),
        "anchors": (M, 3), "guide_coefficients": (M, 3, 6), "guides": (M, N + 1, 3), "controls": (M, N, 4),
        "positions": (M, N + 1, 3), "velocities": (M, N + 1, 3), "quaternions": (M, N + 1, 4), "stage1_cost": (M, K),
        "stage2_cost": (M,), "goal_cost": (M,), "collision_cost": (M,), "clearance": (M, N),
        "samples": (M, K, N + 1, 3), "command": (N, 4),
    }  # fmt: skip
    for name, shape in shapes.items():
        array = getattr(plan, name)
        assert array.shape == shape and array.dtype == np.float32, name
        assert np.isfinite(array).all(), name
    assert plan.kinds == ("anchor",) * 15 + ("previous",)
    assert isinstance(plan.best, int) and isinstance(plan.status, PlanStatus)
    assert plan.stage_ms["total"] > 0.0
    assert Planner(config_of("paper"), device=device).config.kinds == ("anchor",) * 15


@pytest.mark.parametrize("depth", [0.0, 5.0])
def test_continued_cells_are_those_whose_points_were_not_measured(device: str, depth: float):
    case, config = random_case(0), config_of(unseen_space__continuation=depth)
    plan = case.plan(Planner(config, device=device))
    assert plan.continued_cells is not None and plan.continued_cells.dtype == np.bool_
    assert plan.continued_cells.shape == plan.fine_range.shape and plan.continued_cells.any() == (depth > 0.0)
    is_measured = (kept_points(plan)[:, None] == case.points).all(axis=-1).any(axis=1)
    is_occupied = plan.fine_range < config.farthest_range
    np.testing.assert_array_equal(plan.continued_cells[is_occupied], ~is_measured)
    assert not plan.continued_cells[~is_occupied].any()


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("seed", range(3))
def test_without_a_safe_candidate_the_drone_brakes(device: str, preset: str, seed: int):
    """Inside a shell of points and too fast to stay clear of it, the drone flies the braking sequence."""
    config, case = config_of(preset), random_case(seed, tilt=0.3)
    case.velocity, case.acceleration = case.velocity / np.linalg.norm(case.velocity) * 5.0, np.zeros(3)
    case.points = shell(case.position, 0.7)
    planner = Planner(config, device=device)
    plan = case.plan(planner)
    assert plan.status == PlanStatus.NO_SAFE_CANDIDATE
    assert plan.kinds[plan.best] == "brake"
    assert_consistent(plan, case, config)
    x = reference.roll_out(case.position, case.quaternion, case.velocity, plan.controls[plan.best], config)
    # What rates of 3 rad/s leave of 5 m/s: the attitude follows the guide with a lag, to the side even more.
    assert plan.braking is not None and np.linalg.norm(plan.braking.velocities[0, -1]) < 1.5
    assert np.linalg.norm(x.v[-1]) < {"default": 1.5, "paper": 2.0}[preset]
    # It is what the next plan continues with.
    np.testing.assert_array_equal(planner.history().arrays["previous_controls"][0], plan.controls[plan.best])


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_stale_cloud_brakes(device: str, preset: str):
    config, case = config_of(preset, partition__cloud_age_max=0.3), random_case(0, count=0)
    planner = Planner(config, device=device)
    assert case.plan(planner, cloud_age=0.3).status == PlanStatus.OK
    plan = case.plan(planner, cloud_age=0.31)
    assert plan.status == PlanStatus.STALE_CLOUD and plan.kinds[plan.best] == "brake"
    assert_consistent(plan, case, config)
    assert np.linalg.norm(plan.velocities[plan.best, -1]) < 0.5 * np.linalg.norm(case.velocity)
    assert case.plan(planner).status == PlanStatus.OK


def test_a_drone_near_an_obstacle_may_fly_away_from_it(device: str):
    """Nearer than safe_clearance, candidates that come no nearer are safe."""
    config, case = config_of(), random_case(0, tilt=0.0)
    case.velocity, case.acceleration, case.goal = np.zeros(3), np.zeros(3), case.beside(20, 0, 0)
    y, z = np.meshgrid(np.arange(-2, 2, 0.02), np.arange(-2, 2, 0.02))
    wall = np.stack((np.full_like(y, -0.2), y, z), -1).reshape(-1, 3)
    case.points = (wall + case.position).astype(np.float32)
    plan = case.plan(Planner(config, device=device))
    assert plan.status == PlanStatus.OK
    assert plan.positions[plan.best, -1, 0] > case.position[0] + 0.5
    # Toward the wall there is no safe candidate.
    case.velocity = np.array([-3.0, 0.0, 0.0])
    assert case.plan(Planner(config, device=device)).status == PlanStatus.NO_SAFE_CANDIDATE


def test_safe_clearance_is_the_exact_limit(device: str):
    """A candidate is selected up to its own clearance, and not one centimetre beyond."""
    config = config_of("paper", candidates__safe_clearance=0.0)
    planner, checked = Planner(config, device=device), 0
    for seed in range(8):
        case = random_case(seed, nearest=1.1, count=3000)
        planner.configure(config)
        planner.reset()  # for the same noise
        free = case.plan(planner)
        assert free.status == PlanStatus.OK and free.best == np.argmin(free.stage2_cost)
        nearest = float(free.clearance[free.best].min())
        if nearest > 0.95:
            continue  # d_max may hide how far it really is
        planner.configure(config.replace({"candidates.safe_clearance": nearest - 0.001}))
        planner.reset()
        assert case.plan(planner).best == free.best
        planner.configure(config.replace({"candidates.safe_clearance": nearest + 0.01}))
        planner.reset()
        plan = case.plan(planner)
        if plan.status == PlanStatus.OK:
            assert plan.best != free.best and plan.clearance[plan.best].min() >= nearest + 0.00999
        checked += 1
    assert checked > 2


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_same_seed_same_plans(device: str, preset: str):
    a, b = (Planner(config_of(preset), device=device, seed=7) for _ in range(2))
    for seed in range(3):
        assert_same(random_case(seed).plan(a), random_case(seed).plan(b))
    other = Planner(config_of(preset), device=device, seed=8)
    assert not np.array_equal(random_case(0).plan(other).controls, random_case(0).plan(a).controls)


@pytest.mark.parametrize("seed", [-1, 2**31, 10**30])
def test_a_seed_may_be_any_integer(device: str, seed: int):
    a, b = (Planner(device=device, seed=each) for each in (seed, seed % 2**32))
    assert_same(random_case(0).plan(a), random_case(0).plan(b))


def test_the_paper_preset_carries_nothing_from_plan_to_plan(device: str):
    """But for the number of plans, which selects the noise."""
    planners = [Planner(config_of("paper"), device=device) for _ in range(2)]
    for before, planner in enumerate(planners):
        random_case(before).plan(planner)
    assert_same(*(random_case(2).plan(planner) for planner in planners))


def test_threads_do_not_change_the_plan(device: str):
    if device != "cpu":
        pytest.skip("threads share the work on the CPU only")
    planners = [Planner(config_of(), threads=threads) for threads in (1, 2, 5)]
    for seed in range(3):
        one, *others = (random_case(seed).plan(planner) for planner in planners)
        for other in others:
            assert_same(one, other)


def test_a_batch_equals_single_planners(device: str):
    config, cases = config_of(), [random_case(seed, count=400 * seed) for seed in range(3)]
    batch = Planner(config, device=device, seed=5, batch=3)
    singles = [Planner(config, device=device, seed=5 + b) for b in range(3)]
    for _ in range(2):
        together = batch.plan(*batch_of(cases), samples=True)
        for b, (case, single) in enumerate(zip(cases, singles, strict=True)):
            alone = case.plan(single, samples=True)
            for name in [*PLAN_ARRAYS, "samples", "command"]:
                np.testing.assert_array_equal(getattr(together, name)[b], getattr(alone, name), err_msg=name)
            for name in ("best", "status", "dropped_points", "drag"):
                assert getattr(together, name)[b] == getattr(alone, name)


def test_a_launch_leaves_out_inactive_drones_and_plans_the_same_for_the_others(device: str):
    config, cases = config_of(), [random_case(seed) for seed in range(3)]
    planners = [Planner(config, device=device, batch=3) for _ in range(2)]
    for planner in planners:
        planner.plan(*batch_of(cases))
    active = wp.array([1, 0, 1], dtype=int, device=device)
    for mask, changed in ((active, [True, False, True]), (None, [True, True, True])):
        before = planners[0].outputs.stage1_cost.numpy().reshape(3, -1).copy()
        planners[0].launch(active=mask)
        planners[1].launch()
        costs, all_costs = (planner.outputs.stage1_cost.numpy().reshape(3, -1) for planner in planners)
        assert [bool(np.any(costs[b] != before[b])) for b in range(3)] == changed
        commands, all_commands = (planner.command.numpy() for planner in planners)
        for b in (0, 2):
            np.testing.assert_array_equal(costs[b], all_costs[b])
            np.testing.assert_array_equal(commands[b], all_commands[b])


def test_each_drone_of_a_batch_may_have_its_own_configuration(device: str):
    case, planner = random_case(0), Planner(config_of("paper"), device=device, batch=2)
    configs = [config_of("paper", anchors__lookahead=length) for length in (2.0, 4.0)]
    planner.configure(configs)
    plan = planner.plan(*batch_of([case, case]))
    reach = np.linalg.norm(plan.initial_endpoints - case.position, axis=-1)
    np.testing.assert_allclose(reach, np.repeat([[2.0], [4.0]], 15, 1), atol=1e-4)
    with pytest.raises(ValueError, match="1 configurations were given for a batch of 2"):
        planner.configure(configs[:1])
    with pytest.raises(ValueError, match="differ in structure"):
        planner.configure([configs[0], config_of("paper", sampling__samples=8)])


def test_a_rebuild_that_fails_keeps_the_configuration_of_each_drone(monkeypatch: pytest.MonkeyPatch):
    case, planner = random_case(0, count=0), Planner(config_of("paper"), batch=2)
    planner.configure([config_of("paper", anchors__lookahead=length) for length in (2.0, 4.0)])

    def fail(kind: type[Any], sizes: Sizes, device: wp.Device, **present: wp.array) -> Any:
        if sizes.N == 10:
            raise MemoryError("no room")
        return allocate(kind, sizes, device, **present)

    monkeypatch.setattr("aero_planner.structure.allocate", fail)
    with pytest.raises(MemoryError, match="no room"):
        planner.configure(config_of("paper", sampling__steps=10))
    plan = planner.plan(*batch_of([case, case]))
    reach = np.linalg.norm(plan.initial_endpoints - case.position, axis=-1)
    np.testing.assert_allclose(reach, np.repeat([[2.0], [4.0]], 15, 1), atol=1e-4)


def test_a_rebuild_that_fails_keeps_the_previous_plan(monkeypatch: pytest.MonkeyPatch):
    """Neither the arrays of the new structure nor a copy of the present ones needs to fit."""

    def fail(kind: type[Any], sizes: Sizes, device: wp.Device, **present: wp.array) -> Any:
        raise MemoryError("no room")

    plans = []
    for attempt in (False, True):
        case, planner = random_case(0), Planner(config_of())
        case.plan(planner)
        if attempt:
            monkeypatch.setattr("aero_planner.structure.allocate", fail)
            with pytest.raises(MemoryError, match="no room"):
                planner.configure(planner.config.replace({"sampling.steps": 10}))
        plans.append(case.plan(planner))
        planner.close()
    assert_same(*plans)


def test_live_changes_keep_the_buffers(device: str):
    case, planner = random_case(0), Planner(config_of(), device=device)
    before = case.plan(planner)
    pointers = [array.ptr for array in (planner.outputs.controls, planner.command, planner.points, planner.params)]
    planner.configure(
        planner.config.replace({"costs.q_track": 50.0, "anchors.lookahead": 0.5, "anchors.lookahead_time": 0.0})
    )
    after = case.plan(planner)
    assert not np.array_equal(before.controls, after.controls)
    assert np.linalg.norm(after.anchors[7] - case.position) < np.linalg.norm(before.anchors[7] - case.position)
    kept = [array.ptr for array in (planner.outputs.controls, planner.command, planner.points, planner.params)]
    assert kept == pointers
    # The history survives a live change: the previous candidate is the plan before.
    np.testing.assert_array_equal(after.anchors[15], before.positions[before.best, -1])


def test_structural_changes_rebuild(device: str):
    case, planner = random_case(0), Planner(config_of(), device=device)
    case.plan(planner)
    small = config_of(sampling__samples=8, sampling__steps=10, anchors__columns=3, partition__fine_cells=3)
    planner.configure(small)
    plan = case.plan(planner)
    assert plan.controls.shape == (10, 10, 4) and plan.stage1_cost.shape == (10, 8)
    assert plan.fine_range.shape == (30, 60)
    assert_same(plan, case.plan(Planner(small, device=device)))


def test_history_repeats_a_plan(device: str):
    planner = Planner(config_of(), device=device, seed=2)
    for seed in range(2):
        random_case(seed).plan(planner)
    history = planner.history()
    first = random_case(2).plan(planner)
    random_case(3).plan(planner)
    planner.restore(history)
    assert_same(first, random_case(2).plan(planner))
    # Another planner continues as well.
    other = Planner(config_of(), device=device, seed=2)
    other.restore(history)
    assert_same(first, random_case(2).plan(other))
    # A history of another structure resets the planner.
    short = config_of(sampling__steps=10)
    restored, fresh = Planner(short, device=device), Planner(short, device=device)
    restored.restore(history)
    assert_same(random_case(0).plan(restored), random_case(0).plan(fresh))


def test_reset_discards_the_previous_plan(device: str):
    planner = Planner(config_of(), device=device)
    first = random_case(0).plan(planner)
    random_case(1).plan(planner)
    planner.reset()
    assert_same(first, random_case(0).plan(planner))


def test_clouds_grow_and_shrink(device: str):
    planner = Planner(config_of("paper"), device=device)
    for count in (10, 300_000, 0, 40, 2000):
        case = random_case(1, count=count)
        planner.reset()
        assert_same(case.plan(planner), case.plan(Planner(config_of("paper"), device=device)))


def test_points_as_warp_arrays_lists_and_doubles(device: str):
    case, planner = random_case(1), Planner(config_of("paper"), device=device)
    expected = case.plan(planner)
    cloud = case.points
    for points in (
        wp.array(cloud, dtype=wp.vec3, device=device), wp.array(cloud, dtype=wp.vec3, device="cpu"),
        cloud.astype(np.float64), cloud.tolist(), np.asfortranarray(cloud), np.repeat(cloud, 2, axis=0)[::2],
    ):  # fmt: skip
        case.points = points  # type: ignore[assignment]
        planner.reset()
        assert_same(expected, case.plan(planner))


def test_plans_are_not_overwritten(device: str):
    planner = Planner(config_of(), device=device)
    plan = random_case(0).plan(planner)
    copies = {name: getattr(plan, name).copy() for name in PLAN_ARRAYS}
    random_case(1).plan(planner)
    for name in PLAN_ARRAYS:
        np.testing.assert_array_equal(getattr(plan, name), copies[name])


def test_launch_plans_from_device_arrays(device: str):
    case, planner = random_case(0), Planner(config_of(), device=device)
    expected = case.plan(planner)
    planner.reset()
    planner.reserve(len(case.points))
    planner.points.assign(case.points[None])
    planner.launch()
    np.testing.assert_array_equal(planner.command.numpy()[0], expected.command)
    planner.reserve(len(case.points))  # all NaN again
    planner.launch()
    assert planner.outputs.occupied.numpy().sum() == 0


def test_a_read_only_cloud_is_copied_once(device: str):
    """It is copied again after the cloud on the device has changed."""
    case, planner = random_case(0), Planner(config_of(), device=device)
    fresh = case.plan(planner)
    case.points.flags.writeable = False
    for disturb in (
        lambda: None,
        lambda: planner.plan(case.state, Goal(case.goal), np.zeros((0, 3), np.float32)),
        lambda: planner.reserve(10),
        lambda: planner.points.fill_(0.0),
    ):
        case.plan(planner)
        disturb()
        planner.reset()
        again = case.plan(planner)
        np.testing.assert_array_equal(again.filtered_points, fresh.filtered_points)
        np.testing.assert_array_equal(again.controls, fresh.controls)


def test_plans_that_are_kept_are_read_later_as_they_were(device: str):
    """Their arrays are made when they are first read, from memory that later plans may not use."""
    planner, again = (Planner(config_of(), device=device) for _ in range(2))
    cases = [random_case(seed) for seed in range(12)]
    kept = [case.plan(planner) for case in cases]
    for case, plan in zip(cases, kept, strict=True):
        assert_same(plan, case.plan(again))
    with pytest.raises(AttributeError, match="no attribute 'commands'"):
        getattr(kept[0], "commands")  # noqa: B009


def test_device_memory_does_not_wait_for_the_garbage_collector(device: str):
    """It does not know how much memory of a device a reference cycle holds."""
    gc.disable()
    try:
        planner = Planner(config_of(), device=device)
        random_case(0).plan(planner)
        replaced = weakref.ref(planner.workspace.sample_positions)
        planner.configure(config_of("paper"))
        assert replaced() is None
        random_case(0).plan(planner)
        arrays = (planner.workspace.sample_positions, planner.outputs.positions, planner.points, planner.params)
        held = [weakref.ref(array) for array in arrays]
        planner.close()
        del planner, arrays
        assert [reference() for reference in held] == [None] * 4
    finally:
        gc.enable()
