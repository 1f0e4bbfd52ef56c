"""Backup stops: how they are flown, which are clear, and what is flown where no candidate has one."""

# Postponed annotations are left out: the kernel below refers to local types.

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus, Sweeps, VehicleState
from aero_planner.composition import Composition
from aero_planner.device.params import Params
from aero_planner.device.records import Scores, bundle
from aero_planner.kernels.guides import BRAKING_FAN
from aero_planner.kernels.selection import fallback
from aero_planner.stages.stop_proof.stops import STOPS, StopProof, stop_to_keep
from tests.planner import pillars, reference
from tests.planner.cases import PERIOD, Case, config_of, kept_points, level_case, random_case, shell
from tests.planner.pillars import GOAL, plan_from, sweeps_of
from tests.planner.reference import Array

LAGS: dict[str, Any] = {"vehicle.thrust_lag": 0.05, "vehicle.rate_lag": 0.07}


def test_the_stop_that_was_proven_is_flown_when_no_candidate_has_one(device: str):
    case, planner = level_case(speed=5.0), Planner(config_of(), device=device)

    def plan(time: float):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal(case.goal), case.points)

    first = plan(0.0)
    stop = planner.history().arrays["proven_stop"][0].astype(np.float64)
    assert first.status == PlanStatus.OK
    np.testing.assert_array_equal(stop[0], first.command[0])
    x = reference.roll_out(case.position, case.quaternion, case.velocity, stop, planner.config)
    assert np.linalg.norm(x.v[-1]) < 1.0
    case.points = shell(case.position, 0.7)  # no candidate is clear now
    second = plan(0.1)
    assert second.status == PlanStatus.NO_SAFE_CANDIDATE and second.kinds[second.best] == "brake"


def test_stops_are_rolled_out_with_the_lags_of_the_drone(device: str):
    case, planner = level_case(speed=5.0), Planner(config_of().replace(LAGS), device=device)
    plan, config = case.plan(planner), planner.config
    arrays, N = planner.arrays_of("stop_proof"), config.sampling.steps
    stop_controls, stop_positions = arrays["stop_controls"].numpy()[0], arrays["stop_positions"].numpy()[0]
    best = int(plan.best)
    for stop, switch in ((0, 1), (3, N // 4), (5, N)):
        row = best * int(STOPS) + stop
        controls = np.concatenate((plan.controls[best, :switch], stop_controls[row]))
        x = reference.roll_out(case.position, case.quaternion, case.velocity, controls, config)
        np.testing.assert_allclose(stop_positions[row, 1:], x.p[switch:], atol=2e-3)


def test_a_stop_is_forgotten_while_stops_are_not_proven(device: str):
    case, config = level_case(speed=5.0), config_of()
    planner = Planner(config, device=device)
    case.plan(planner)
    assert planner.history().arrays["proven_stop_age"][0] == 0.0
    planner.configure(config.replace({"stop_proof.prove_stop": False}))
    case.plan(planner)
    assert np.isinf(planner.history().arrays["proven_stop_age"][0])


def test_the_stop_that_was_proven_is_no_braking_candidate_of_a_plan(device: str):
    """It may take two horizons, so that it does not end at rest as the braking candidates do."""
    plan = level_case(speed=5.0).plan(Planner(config_of(), device=device))
    assert plan.braking is not None
    assert len(plan.braking.positions) == len(plan.braking.velocities) == len(plan.braking.clearance) == 5


def switch_steps(config: PlannerConfig) -> list[int]:
    """Return the time step at which each stop leaves its candidate, in the first plan."""
    N = config.sampling.steps
    first = int(np.ceil(PERIOD / config.sampling.dt))
    return [max(first, step) for step in (0, 0, 0, N // 4, N // 2, N)]


def stop_clearances(case: Case, planner: Planner, plan: Plan) -> tuple[Array, Array]:
    """Return the clearance of each stop in the first plan, and whether it is far from any limit, both [M * STOPS]."""
    config, positions = planner.config, planner.arrays_of("stop_proof")["stop_positions"].numpy()[0].astype(np.float64)
    controls = planner.arrays_of("stop_proof")["stop_controls"].numpy()[0].astype(np.float64)
    margin, safe = config.candidates.speed_margin, config.candidates.safe_clearance
    R = reference.rotation(reference.unit(case.quaternion))
    clearances, is_sure = np.zeros(len(positions)), np.ones(len(positions), bool)
    for row in range(len(positions)):
        m, switch = row // int(STOPS), switch_steps(config)[row % int(STOPS)]
        speeds = np.linalg.norm(np.diff(positions[row], axis=0), axis=1) / config.sampling.dt
        x = np.concatenate((positions[row, 1:], plan.positions[m, 1 : switch + 1]))
        v = np.concatenate((speeds, np.linalg.norm(plan.velocities[m, 1 : switch + 1], axis=1)))
        offsets = x - case.position
        distance = np.linalg.norm(offsets, axis=1)
        i, j, border = reference.cell_indices(offsets @ R, *plan.fine_range.shape)
        is_occluded = (distance > 0.5) & (distance > plan.fine_range[i, j])
        is_sure[row] = ((border > 1e-3) & (np.abs(distance - plan.fine_range[i, j]) > 1e-3) | (distance < 0.49)).all()
        flown = np.concatenate((plan.controls[m, :switch], controls[row]))
        end = reference.roll_out(case.position, case.quaternion, case.velocity, flown, config).v[-1]
        is_sure[row] &= abs(np.linalg.norm(end) - 1.0) > 0.01
        clear = np.where(is_occluded, 0.0, reference.clearance(x, kept_points(plan), 10.0) - margin * v).min()
        clearances[row] = min(clear, safe) if np.linalg.norm(end) < 1.0 else 0.0
    return clearances, is_sure


def test_stops_are_clear_if_all_their_states_are_clear_and_seen(device: str):
    """One that is not clear need not be evaluated to its end. The best of the instances with a clear stop is flown."""
    config = config_of(anchors__columns=3, anchors__rows=2)
    planner, clear, unclear = Planner(config, device=device), 0, 0
    least = min(config.stop_proof.stop_clearance, config.candidates.safe_clearance)
    for seed in range(12):
        planner.reset()
        case = random_case(seed, nearest=0.8 + 0.05 * seed, count=600, tilt=0.3)
        plan = case.plan(planner)
        found = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0]
        has_stop = (found.reshape(-1, int(STOPS)) >= least).any(axis=1)
        if plan.status != PlanStatus.OK:  # a braking candidate has replaced what the stops belong to
            assert not has_stop.any()
            continue
        assert plan.best == np.argmin(np.where(has_stop, plan.stage2_cost, np.inf))
        expected, is_sure = stop_clearances(case, planner, plan)
        is_sure &= np.abs(expected - least) > 1e-4
        is_clear = expected >= least
        np.testing.assert_allclose(found[is_sure & is_clear], expected[is_sure & is_clear], atol=1e-4)
        assert (found[is_sure & ~is_clear] < least).all()
        clear, unclear = clear + np.sum(is_sure & is_clear), unclear + np.sum(is_sure & ~is_clear)
    assert clear > 20 and unclear > 20


def test_a_stop_behind_what_was_seen_is_not_clear(device: str):
    """Between two walls, a stop that leads past the edge of the first one is clear only without that wall."""
    planner, is_clear = Planner(config_of(unseen_space__continuation=0.0), device=device), []
    case = level_case(speed=4.0)
    y, z = np.meshgrid(np.arange(-3, 3, 0.04), np.arange(-3, 3, 0.04))
    screen = np.stack((np.full_like(y, 1.2), y, z), axis=-1).reshape(-1, 3)
    hole = screen[np.maximum(np.abs(screen[:, 1]), np.abs(screen[:, 2])) > 0.62]
    for points in (hole, hole[:0]):
        case.points = points.astype(np.float32)
        planner.reset()
        plan = case.plan(planner)
        expected, is_sure = stop_clearances(case, planner, plan)
        found = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0]
        assert (found[is_sure & (expected == 0.0)] < planner.config.stop_proof.stop_clearance).all()
        is_clear.append(int((found >= planner.config.stop_proof.stop_clearance).sum()))
    assert is_clear[0] < is_clear[1]


def test_a_dynamic_obstacle_that_is_near_at_the_start_may_be_left(device: str):
    """It passes by behind the drone, nearer than a stop must keep away, and comes no nearer."""
    planner = Planner(config_of(), device=device)
    sweeps, position = sweeps_of([(np.array([-0.5, -0.6]), np.array([0.0, 2.0]))], np.zeros(3))
    plan = plan_from(planner, sweeps, position, later=0.3)
    least, work = planner.config.stop_proof.stop_clearance, planner.workspace
    start, static = (clearance.numpy()[0, 0, -1] for clearance in (work.state_clearance, work.static_clearance))
    assert 0.1 < start < least - 0.03 and static > least
    assert plan.status == PlanStatus.OK
    stops = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0].reshape(-1, int(STOPS))
    assert (stops[:, :3] >= least).any(), "also of those that leave at once"


def closing_in(planner: Planner, *, period: float = 0.02, count: int = 6) -> tuple[list[Plan], list[Array]]:
    """Return plans of a drone on which pillars on all sides close in after the first plan, and the flown positions."""
    sweeps = pillars.closing_in()
    arrival = sweeps.arrivals[-1]
    assert arrival is not None
    position, velocity, attitude = np.zeros(3), np.array([3.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    config = planner.config.replace({"sampling.dt": period})
    cloud, plans, flown = Sweeps([np.full((1, 3), 60.0, np.float32)]), [], [position]
    for k in range(count):
        state = VehicleState(position, velocity, attitude, time=arrival.time + period * k)
        plans.append(planner.plan(state, GOAL, cloud))
        x = reference.roll_out(position, attitude, velocity, plans[-1].command[:1].astype(np.float64), config)
        position, velocity, attitude, cloud = x.p[-1], x.v[-1], x.q[-1], sweeps
        flown.append(position)
    return plans, flown


def test_a_proven_stop_that_is_clear_of_static_obstacles_is_flown_whatever_moves(device: str):
    planner = Planner(config_of(sampling__dt=0.05), device=device)
    plans, _ = closing_in(planner)
    assert plans[0].status == PlanStatus.OK
    assert all(plan.status == PlanStatus.NO_SAFE_CANDIDATE for plan in plans[1:])
    assert plans[-1].moving is not None and len(plans[-1].moving.positions) == 20
    assert planner.history().arrays["proven_stop_age"][0] == pytest.approx(0.1)


@pytest.mark.parametrize(("period", "count"), [(0.02, 10), (0.049, 5), (0.05, 4)])
def test_a_proven_stop_is_flown_as_it_was_proven(device: str, period: float, count: int):
    """However often the planner plans meanwhile, the drone is where the stop leads; its time step is 0.05 s."""
    planner = Planner(config_of(sampling__dt=0.05), device=device)
    plans, flown = closing_in(planner, period=period, count=count)
    assert all(plan.status == PlanStatus.NO_SAFE_CANDIDATE for plan in plans[1:])
    fine = planner.config.replace({"sampling.dt": 0.005})
    stop = planner.history().arrays["proven_stop"][0].astype(np.float64)
    controls = np.repeat(stop, 10, axis=0)[: round(200 * period * count)]
    expected = reference.roll_out(flown[0], np.array([1.0, 0, 0, 0]), np.array([3.0, 0, 0]), controls, fine)
    np.testing.assert_allclose(flown[-1], expected.p[-1], atol=2e-3)
    for plan in plans:
        np.testing.assert_array_equal(plan.command, plan.controls[plan.best])


@functools.cache
def fallback_kernel(composition: Composition) -> Any:
    choose = fallback(composition)
    Views: Any = composition.Views
    AllScores: Any = Scores

    @wp.kernel(module="unique", enable_backward=False)
    def fallback_kernel(
        status: int, instances: int, demanded: float, scores: AllScores, views: Views, params: wp.array(dtype=Params),
        out: wp.array(dtype=int),
    ):  # fmt: skip
        out[0] = choose(0, instances, status, demanded, scores, views, params[0])

    return fallback_kernel


def choose_fallback(
    planner: Planner,
    braking: Sequence[tuple[float, float]],
    stops: Array,
    *,
    status: PlanStatus = PlanStatus.NO_SAFE_CANDIDATE,
) -> int:
    """Return the row that is flown if no instance is admissible.

    `braking` are the clearances of two braking candidates and the proven stop, from all and from static obstacles;
    `stops` those of the stops of each instance, [M, STOPS].
    """
    device, instances, (*fan, proven) = planner.device, len(stops), braking
    rows = np.array([[*[(-1.0, -1.0)] * instances, *fan, *[(-2.0, -2.0)] * (int(BRAKING_FAN) - 2), proven]])
    least = wp.array(rows, dtype=wp.vec2, device=device)
    start = wp.full((1, rows.shape[1], 1), 1.0, dtype=float, device=device)  # clearance at the start
    composition = Composition.of(planner.config)
    views = composition.Views()
    views.stop_proof = bundle(
        StopProof,
        stop_clearance=wp.array(stops.reshape(1, -1), dtype=float, device=device),
        stop_ready=wp.ones(1, dtype=int, device=device),
        least_clearance=least,
        static_clearance=start,
    )
    out = wp.zeros(1, dtype=int, device=device)
    scores = bundle(Scores, least_clearance=least, static_clearance=start)
    inputs = [int(status), instances, 0.3, scores, views, planner.params, out]
    wp.launch(fallback_kernel(composition), 1, inputs=inputs, device=device)
    return int(out.numpy()[0])


@pytest.mark.parametrize(
    ("braking", "flown"),
    [
        ([(0.4, 0.4), (0.5, 0.5), (0.35, 0.35)], 6),  # the proven stop comes first
        ([(0.4, 0.4), (0.5, 0.5), (0.2, 0.2)], 2),  # the largest clearance
        ([(0.4, 0.4), (0.1, 0.5), (0.0, 0.35)], 1),  # it evades what moves, while the proven stop does not
        ([(0.2, 0.5), (0.1, 0.5), (0.0, 0.35)], 6),  # nothing evades what moves
        ([(0.25, 0.25), (0.1, 0.5), (0.0, 0.2)], 2),  # static obstacles count more
        ([(0.25, 0.25), (0.1, 0.2), (0.0, 0.2)], 1),
    ],
)
@pytest.mark.parametrize("status", [PlanStatus.NO_SAFE_CANDIDATE, PlanStatus.STALE_CLOUD])
def test_static_obstacles_decide_first_what_is_flown_instead(
    device: str, braking: list[tuple[float, float]], flown: int, status: PlanStatus
):
    """With a cloud that is too old, the proven stop is not flown."""
    stops = np.full((1, int(STOPS)), -1.0)
    if flown == 6 and status == PlanStatus.STALE_CLOUD:
        flown = 2 if braking[1][0] > braking[0][0] else 1
    assert choose_fallback(Planner(config_of(), device=device), braking, stops, status=status) == flown


@pytest.mark.parametrize(
    ("braking", "widest", "is_flown"),
    [
        ((0.20, 0.20), 0.25, True),
        ((0.26, 0.26), 0.25, False),  # braking keeps a larger clearance
        ((0.30, 0.30), 0.25, False),  # braking is clear
        ((0.20, 0.30), 0.25, False),  # it is clear of static obstacles
        ((0.05, 0.05), 0.13, False),  # contact is certain, and braking makes it slow
    ],
)
@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({}, PlanStatus.NO_SAFE_CANDIDATE),
        ({}, PlanStatus.STALE_CLOUD),
        ({"candidates.prefer_safe": False}, PlanStatus.NO_SAFE_CANDIDATE),
        ({"stop_proof.prove_stop": False}, PlanStatus.NO_SAFE_CANDIDATE),
    ],
)
def test_where_no_braking_is_clear_the_instance_with_the_widest_stop_is_flown(
    device: str,
    braking: tuple[float, float],
    widest: float,
    is_flown: bool,
    changes: dict[str, bool],
    status: PlanStatus,
):
    """Only with proven stops, a cloud that is not too old, and `prefer_safe`."""
    planner = Planner(config_of().replace(changes), device=device)
    stops = np.full((3, int(STOPS)), 0.01)
    stops[1, 0], stops[2, 4] = min(0.12, widest), widest
    flown = choose_fallback(planner, [braking] * 3, stops, status=status)
    is_flown &= not changes and status == PlanStatus.NO_SAFE_CANDIDATE
    assert flown == 2 if is_flown else flown >= len(stops)


def test_in_a_plan_the_widest_stop_of_all_is_flown_where_no_braking_is_clear(device: str):
    """Stops are only evaluated as far as they may be the widest. Without `prefer_safe`, the drone brakes."""
    config = config_of()
    planner, flown = Planner(config, device=device), 0
    for seed in range(18):
        planner.reset()
        case = random_case(seed, nearest=0.8 + 0.02 * (seed % 20), tilt=0.3, speed=6.0)
        plan = case.plan(planner)
        if plan.status == PlanStatus.OK or plan.kinds[plan.best] == "brake":
            continue
        assert plan.status == PlanStatus.NO_SAFE_CANDIDATE and plan.braking is not None
        expected, is_sure = stop_clearances(case, planner, plan)
        found = planner.arrays_of("stop_proof")["stop_clearance"].numpy()[0]
        widest = int(np.argmax(found))
        assert plan.best == widest // int(STOPS)
        if not is_sure[widest]:  # float32 may put it on the other side of an edge
            continue
        flown += 1
        assert found[widest] == pytest.approx(expected[widest], abs=1e-4)
        assert found[widest] < config.stop_proof.stop_clearance
        assert (np.maximum(found, 0.0)[is_sure] >= expected[is_sure] - 1e-4).all()  # in contact or occluded is the same
        braking = planner.workspace.least_clearance.numpy()[0, len(config.kinds) : -1]
        assert braking[:, 0].max() < found[widest] and braking[:, 1].max() < config.stop_proof.stop_clearance
        planner.reset()
        planner.configure(config.replace({"candidates.prefer_safe": False}))
        braked = case.plan(planner)
        planner.configure(config)
        assert braked.status != PlanStatus.OK and braked.kinds[braked.best] == "brake"
    assert flown > 2


@wp.kernel
def kept_kernel(m: int, demanded: float, stop_clearance: wp.array2d(dtype=float), out: wp.array(dtype=int)):
    out[0] = stop_to_keep(0, m, demanded, stop_clearance)


@pytest.mark.parametrize(
    ("stops", "kept"),
    [
        ((0.1, 0.3, 0.5, 0.2, 0.4, 0.5), 1),  # the first one that is clear, not the widest
        ((0.3, 0.5, 0.5, 0.5, 0.5, 0.5), 0),
        ((0.2, 0.1, 0.0, 0.1, 0.2, 0.3), 5),
        ((0.1, 0.2, 0.29, 0.1, 0.28, 0.0), 2),  # the widest where none is clear
        ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0),
    ],
)
def test_the_first_clear_stop_is_kept(device: str, stops: tuple[float, ...], kept: int):
    others = np.full((1, int(STOPS)), 0.6)
    rows = np.concatenate((others, np.array([stops]), others), axis=1)
    clearance, out = wp.array(rows, dtype=float, device=device), wp.zeros(1, dtype=int, device=device)
    wp.launch(kept_kernel, 1, inputs=[1, 0.3, clearance, out], device=device)
    assert out.numpy()[0] == int(STOPS) + kept


@pytest.mark.parametrize("prefer_safe", [True, False])
def test_the_stop_that_is_kept_is_the_first_clear_one_of_the_selected_instance(device: str, prefer_safe: bool):
    """The selected instance is the best of those with a clear stop, or of all of them without `prefer_safe`."""
    config = config_of(candidates__prefer_safe=prefer_safe, anchors__columns=3, anchors__rows=2)
    planner, later = Planner(config, device=device), 0
    least = min(config.stop_proof.stop_clearance, config.candidates.safe_clearance)
    for seed in range(40):
        planner.reset()
        plan = random_case(seed, nearest=0.6 + 0.05 * (seed % 20), tilt=0.3).plan(planner)
        if plan.status != PlanStatus.OK:
            continue
        arrays, m = planner.arrays_of("stop_proof"), int(plan.best)
        found = arrays["stop_clearance"].numpy()[0].reshape(-1, int(STOPS))
        has_stop = (found >= least).any(axis=1) if prefer_safe else np.ones(len(found), bool)
        assert m == np.argmin(np.where(has_stop, plan.stage2_cost, np.inf))
        first, switches = int(np.argmax(found[m] >= least)), switch_steps(config)
        assert found[m, first] >= least
        stop, switch = arrays["stop_controls"].numpy()[0, m * int(STOPS) + first], switches[first]
        kept = arrays["proven_stop"].numpy()[0]
        np.testing.assert_array_equal(kept[: switch + len(stop)], np.concatenate((plan.controls[m, :switch], stop)))
        later += first > 0
    assert later > 2
