"""Continued surfaces, proven stops, places without progress, and the prediction of the start."""

import dataclasses

import numpy as np
import pytest

from aero_planner import Goal, Plan, Planner, PlannerConfig, PlanStatus, VehicleState
from aero_planner.kernels.stops import STOPS
from tests.planner import reference
from tests.planner.cases import Case, config_of, kept_points, random_case, shell


def level(x: float = 20.0, *, speed: float = 0.0) -> Case:
    """Return a level drone at the origin with the goal `x` ahead and no cloud."""
    case = random_case(0, count=0)
    case.position, case.velocity, case.acceleration = np.zeros(3), np.array([speed, 0.0, 0.0]), np.zeros(3)
    case.quaternion, case.goal = np.array([1.0, 0.0, 0.0, 0.0]), np.array([x, 0.0, 0.0])
    return case


@pytest.mark.parametrize("depth", [0.0, 1.0, 2.0])
def test_a_wall_continues_below_the_field_of_view(device: str, depth: float):
    """The points that are added lie on the wall, below its seen part and at most `depth` deeper."""
    case, edge = level(), -4.0 * np.tan(np.radians(7.0))
    y, z = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(edge, 2, 0.05))
    case.points = np.stack((np.full_like(y, 4.0), y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    plan = case.plan(Planner(config_of(partition__continue_below=depth), device=device))
    kept = kept_points(plan).astype(np.float64)
    added = kept[kept[:, 2] < edge - 0.1]
    assert (len(added) > 0) == (depth > 0.0)
    if depth > 0.0:
        # A neighbouring column of cells may hold the source: 3 deg at 4 m change x by at most 0.1 m.
        np.testing.assert_allclose(added[:, 0], 4.0, atol=0.15)
        assert added[:, 2].min() > edge - depth - 0.1 and added[:, 2].min() < edge - 0.7 * depth


@pytest.mark.parametrize("height", [0.0, 1.0, 2.0])
def test_a_wall_continues_above_the_field_of_view(device: str, height: float):
    """The points that are added lie on the wall, above its seen part and at most `height` higher."""
    case, edge = level(), 2.0 * np.tan(np.radians(52.0))
    y, z = np.meshgrid(np.arange(-1, 1, 0.03), np.arange(-0.2, edge, 0.03))
    case.points = np.stack((np.full_like(y, 2.0), y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    config = config_of(partition__continue_above=height, partition__continue_below=0.0)
    kept = kept_points(case.plan(Planner(config, device=device))).astype(np.float64)
    added = kept[kept[:, 2] > edge + 0.1]
    assert (len(added) > 0) == (height > 0.0)
    if height > 0.0:
        np.testing.assert_allclose(added[:, 0], 2.0, atol=0.15)
        assert added[:, 2].max() < edge + height + 0.1 and added[:, 2].max() > edge + 0.5 * height


def test_the_stop_that_was_proven_is_flown_when_no_candidate_has_one(device: str):
    case, planner = level(speed=5.0), Planner(config_of(), device=device)

    def plan(time: float):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal(case.goal), case.points)

    first = plan(0.0)
    stop = planner.history().stop[0].astype(np.float64)
    assert first.status == PlanStatus.OK
    np.testing.assert_array_equal(stop[0], first.command[0])
    x = reference.roll_out(case.position, case.quaternion, case.velocity, stop, planner.config)
    assert np.linalg.norm(x.v[-1]) < planner.config.candidates.stop_speed
    case.points = shell(case.position, 0.7)  # no candidate is clear now
    second = plan(0.1)
    assert second.status == PlanStatus.NO_SAFE_CANDIDATE and second.kinds[second.best] == "brake"


def test_a_slow_drone_that_makes_progress_remembers_nothing(device: str):
    case, config = level(), config_of(vehicle__speed_limit=1.0)
    planner = Planner(config, device=device)
    for k in range(20):
        position = np.array([0.09 * k, 0.0, 0.0])  # 0.9 m/s
        state = VehicleState(position, case.velocity, case.quaternion, case.acceleration, time=0.1 * k)
        planner.plan(state, Goal(case.goal), case.points)
    assert planner.history().place_count[0] == 0


def test_a_drone_without_progress_remembers_where_it_was(device: str):
    config = config_of(escape__patience=0.5)
    case, planner = level(), Planner(config, device=device)
    for k in range(13):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=0.1 * k)
        planner.plan(state, Goal(case.goal), case.points)
    history = planner.history()
    assert history.place_count[0] == 2
    np.testing.assert_array_equal(history.places[0, :2], np.zeros((2, 3)))
    planner.plan(case.state, Goal([0.0, 20.0, 0.0]), case.points)
    assert planner.history().place_count[0] == 0


@pytest.mark.parametrize("ahead", [0.5, 2.0, 1000.0])
def test_places_without_progress_cost_less_the_nearer_to_the_goal_a_rollout_ends(device: str, ahead: float):
    case, planner = level(3.0), Planner(config_of(escape__ahead=ahead, costs__q_speed=0.0), device=device)

    def plan(time: float) -> Plan:
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal(case.goal), case.points)

    for k in range(6):
        plan(0.1 * k)
    history = planner.history()
    places, nearest = history.places[0, : history.place_count[0]].astype(np.float64), float(history.place_nearest[0])
    last = plan(0.6)
    ends = last.positions[:, -1].astype(np.float64)
    expected = [reference.escape_cost(p, places, nearest, case.goal, planner.config) for p in ends]
    expected[last.kinds.index("previous")] *= 1.0 - planner.config.escape.previous_discount
    np.testing.assert_allclose(last.stage2_cost - last.goal_cost, expected, rtol=1e-4, atol=0.02)
    full = [reference.escape_cost(p, places, 0.0, case.goal, planner.config) for p in ends]
    assert len(places) >= 2 and nearest == 3.0
    assert (sum(expected) < 0.8 * sum(full)) == (ahead < 1000.0)


@pytest.mark.parametrize("aside", [0.0, 1.0])
def test_a_drone_that_has_passed_its_goal_comes_back(device: str, aside: float):
    """It makes no progress meanwhile, and must not keep away from the places of its way back."""
    config = config_of(vehicle__speed_limit=5.0, sampling__samples=64, sampling__steps=25)
    planner, goal, dt = Planner(config, device=device, seed=1), np.array([1.5, 0.0, 3.0]), config.sampling.dt
    position, velocity, attitude = np.array([0.0, aside, 3.0]), np.array([5.0, 0.0, 0.0]), np.array([1.0, 0, 0, 0])
    distances = []
    for k in range(150):
        plan = planner.plan(
            VehicleState(position, velocity, attitude, time=k * dt), Goal(goal), np.full((64, 3), 40.0, np.float32)
        )
        x = reference.roll_out(position, attitude, velocity, plan.command[:1].astype(np.float64), config)
        position, velocity, attitude = x.p[-1], x.v[-1], x.q[-1]
        distances.append(np.linalg.norm(position - goal))
    assert max(distances) > 1.0 and max(distances[-20:]) < 0.3


def test_plans_start_from_the_state_after_the_delay(device: str):
    case, planner = random_case(3, count=0), Planner(config_of(vehicle__delay=0.1), device=device)
    plan = case.plan(planner)  # without a previous plan the drone hovers until then
    config = planner.config.replace({"sampling.dt": 0.01})
    hover = np.tile([config.vehicle.mass * config.vehicle.gravity, 0.0, 0.0, 0.0], (10, 1))
    x = reference.roll_out(case.position, reference.unit(case.quaternion), case.velocity, hover, config)
    np.testing.assert_allclose(plan.positions[0, 0], x.p[-1], atol=1e-5)
    np.testing.assert_allclose(plan.velocities[0, 0], x.v[-1], atol=1e-5)


LAGS = {"vehicle.thrust_lag": 0.05, "vehicle.rate_xy_lag": 0.07, "vehicle.rate_z_lag": 0.07}


def test_stops_are_rolled_out_with_the_lags_of_the_drone(device: str):
    case, planner = level(speed=5.0), Planner(config_of().replace(LAGS), device=device)
    plan, config = case.plan(planner), planner.config
    work, N = planner.workspace, config.sampling.steps
    stop_controls, stop_positions = work.stop_controls.numpy()[0], work.stop_positions.numpy()[0]
    best = int(plan.best)
    for stop, switch in ((0, 1), (3, N // 4), (5, N)):
        row = best * int(STOPS) + stop
        controls = np.concatenate((plan.controls[best, :switch], stop_controls[row]))
        x = reference.roll_out(case.position, case.quaternion, case.velocity, controls, config)
        np.testing.assert_allclose(stop_positions[row, 1:], x.p[switch:], atol=2e-3)


def test_a_stop_is_forgotten_while_stops_are_not_proven(device: str):
    case, config = level(speed=5.0), config_of()
    planner = Planner(config, device=device)
    case.plan(planner)
    assert planner.history().stop_age[0] == 0.0
    planner.configure(config.replace({"candidates.prove_stop": "off"}))
    case.plan(planner)
    assert np.isinf(planner.history().stop_age[0])


def test_the_stop_that_was_proven_is_no_braking_candidate_of_a_plan(device: str):
    """It may take two horizons, so that it does not end at rest as the braking candidates do."""
    plan = level(speed=5.0).plan(Planner(config_of(), device=device))
    assert plan.braking is not None
    assert len(plan.braking.positions) == len(plan.braking.velocities) == len(plan.braking.clearance) == 5


def test_the_prediction_follows_the_commands_of_the_previous_plan_with_the_lags(device: str):
    config = config_of(vehicle__delay=0.1).replace(LAGS)
    case, planner = level(speed=3.0), Planner(config, device=device)

    def plan(time: float):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal([3.0, 8.0, 4.0]), case.points)

    command = plan(0.0).command.astype(np.float64)
    second = plan(0.1)  # the commands sent until now arrive from now on
    sent = 0.01 * (np.arange(10) + 0.5) / config.sampling.dt
    arriving = np.stack([np.interp(sent, np.arange(len(command)), u) for u in command.T], axis=1)
    fine = config.replace({"sampling.dt": 0.01})
    x = reference.roll_out(case.position, case.quaternion, case.velocity, arriving, fine)
    np.testing.assert_allclose(second.positions[0, 0], x.p[-1], atol=1e-4)
    np.testing.assert_allclose(second.velocities[0, 0], x.v[-1], atol=1e-3)
    np.testing.assert_allclose(second.quaternions[0, 0], x.q[-1], atol=1e-4)


@pytest.mark.parametrize("above", [0.0, 3.0])
@pytest.mark.parametrize("before", [0.5, 1e3])
def test_continued_cells_are_those_of_the_rule(device: str, above: float, before: float):
    """The drone has turned since the plan before; rounding may decide for a few of the cells."""
    config = config_of(
        partition__continue_below=2.0, partition__continue_above=above, partition__continue_before=before
    )
    without = config.replace({"partition.continue_below": 0.0, "partition.continue_above": 0.0})
    planner, filled, different = Planner(config, device=device), 0, 0
    for seed in range(3):
        case = random_case(seed, count=3000, tilt=0.4)
        measured = case.plan(Planner(without, device=device))
        turned = dataclasses.replace(case, quaternion=random_case(seed + 100, tilt=0.4).quaternion)
        planner.reset()
        turned.plan(planner)
        found = case.plan(planner).fine_range.ravel()
        expected = continued_ranges(case, config, measured, turned.quaternion)
        filled += np.sum(expected != measured.fine_range.ravel())
        different += np.sum(np.abs(found - expected) > 1e-3)
    assert filled > 300 and different <= 0.02 * filled


def continued_ranges(case: Case, config: PlannerConfig, measured: Plan, before: np.ndarray) -> np.ndarray:
    """Return the fine ranges [m] with continued surfaces, shape [F].

    `measured` is a plan without them, and `before` the attitude at the plan before, which was the first one.
    """
    part, R, ranges = config.partition, reference.rotation(reference.unit(case.quaternion)), measured.fine_range
    rows, columns = ranges.shape
    elevation = np.repeat((np.arange(rows) + 0.5) * np.pi / rows - np.pi / 2, columns)
    azimuth = np.tile((np.arange(columns) + 0.5) * 2 * np.pi / columns - np.pi, rows)
    directions = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)))

    def cells_of(d: np.ndarray) -> np.ndarray:
        row = np.floor((np.arctan2(d[2], np.hypot(d[0], d[1])) / np.pi + 0.5) * rows).astype(int)
        column = np.floor((np.arctan2(d[1], d[0]) / (2 * np.pi) + 0.5) * columns).astype(int) % columns
        return np.clip(row, 0, rows - 1) * columns + column

    q, before = reference.unit(case.quaternion), reference.unit(before)
    period = config.sampling.replan_period
    share = period / (period + part.view_age)
    seen_from = reference.rotation(reference.unit((1.0 - share) * before * np.sign(before @ q) + share * q))
    offsets = np.full((3, rows * columns), np.inf)
    offsets[:, ranges.ravel() < config.farthest_range] = (
        np.asarray(measured.filtered_points, dtype=float) - case.position
    ).T
    result, limits = ranges.ravel().astype(float), (part.continue_below, part.continue_above)
    lower, upper = elevation - np.radians(part.view_min), np.radians(part.view_max) - elevation
    world = R @ directions
    flat = np.hypot(world[0], world[1])
    for side in (0, 1):
        source = cells_of(R.T @ directions)
        x = offsets[:, source]
        has_point = np.isfinite(x[0])
        x[:, ~has_point] = 1.0
        earlier = seen_from.T @ (x + part.view_age * case.velocity[:, None])
        angle = np.arctan2(earlier[2], np.hypot(earlier[0], earlier[1]))
        then = angle - np.radians(part.view_min) if side == 0 else np.radians(part.view_max) - angle
        is_edge = np.minimum((lower, upper)[side][source], then) <= 2 * np.pi / rows
        away = np.where(has_point & is_edge, np.hypot(x[0], x[1]), np.inf).reshape(rows, columns)
        height = x[2].reshape(rows, columns)
        order = range(rows - 1, -1, -1) if side == 0 else range(rows)
        nearest, level = np.full(columns, np.inf), np.zeros(columns)
        for row in order:
            is_nearer = away[row] < nearest + 0.1
            nearest, level = np.where(is_nearer, away[row], nearest), np.where(is_nearer, height[row], level)
            away[row], height[row] = nearest, level
        place = cells_of(world)
        distance = away.ravel()[place] / np.maximum(flat, 0.2)
        depth = (height.ravel()[place] - distance * world[2]) * (1 if side == 0 else -1)
        is_filled = (lower <= upper if side == 0 else upper < lower) & (flat >= 0.2) & (depth <= limits[side])
        is_filled &= (distance <= config.farthest_range) & (limits[side] > 0.0)
        is_empty = ranges.ravel() == config.farthest_range
        is_filled &= is_empty | (ranges.ravel() > distance + part.continue_before)
        result[is_filled] = distance[is_filled]
    return result


@pytest.mark.parametrize("period", [0.02, 0.1])
def test_the_attitude_of_the_view_is_the_given_one_of_some_time_ago(device: str, period: float):
    """Recorded drones do not follow the commands of the planner: what counts is how they turned."""
    config, rate = config_of(partition__view_age=0.1), 1.0
    planner, case = Planner(config, device=device), level()
    for tick in range(round(1.0 / period) + 1):
        half = 0.5 * rate * tick * period
        attitude = np.array([np.cos(half), 0.0, np.sin(half), 0.0]) * (-1.0) ** tick  # q and -q are the same attitude
        state = VehicleState(case.position, case.velocity, attitude, case.acceleration, time=tick * period)
        planner.plan(state, Goal(case.goal), case.points)
    w, _, y, _ = planner.history().view_quaternion[0]
    assert 2.0 * np.arctan2(y, w) % (2.0 * np.pi) == pytest.approx(rate * (1.0 - 0.1), abs=1e-3)
    planner.reset()
    case.plan(planner)
    np.testing.assert_array_equal(planner.history().view_quaternion[0], case.quaternion)


def test_a_wall_that_has_just_come_into_view_continues(device: str):
    """A descending drone has its lower edge of view below what the newest sweep saw."""
    case, edge = level(), -0.2
    y, z = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(edge, 2, 0.05))
    case.points = np.stack((np.full_like(y, 3.0), y, z), axis=-1).reshape(-1, 3).astype(np.float32)
    case.points += [0.0, 0.0, 0.7]  # the drone has sunk by 0.7 m since

    def lowest(age: float = 0.1) -> float:
        config = config_of(partition__continue_above=0.0, partition__view_age=age)
        kept = kept_points(case.plan(Planner(config, device=device)))
        return float(kept[np.abs(kept[:, 1]) < 1.0, 2].min())

    assert lowest() > edge + 0.65  # at rest, what is in view was seen
    case.velocity = np.array([0.0, 0.0, -7.0])
    assert lowest() < -4.0
    assert lowest(age=0.0) > edge + 0.65


def test_a_surface_continues_before_points_that_were_seen_from_elsewhere(device: str):
    case, edge = level(), -2.0 * np.tan(np.radians(7.0))
    y, z = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(edge, 1, 0.05))
    trunk = np.stack((np.full_like(y, 2.0), y, z), axis=-1).reshape(-1, 3)
    y, z = np.meshgrid(np.arange(-3, 3, 0.1), np.arange(-3, 0, 0.1))
    behind = np.stack((np.full_like(y, 4.0), y, z), axis=-1).reshape(-1, 3)
    case.points = np.concatenate((trunk, behind)).astype(np.float32)
    for before, is_hidden in ((1.0, True), (1e3, False)):
        config = config_of(partition__continue_before=before, partition__continue_above=0.0)
        kept = kept_points(case.plan(Planner(config, device=device)))
        ahead = kept[(np.abs(kept[:, 1]) < 0.5) & (kept[:, 2] < -0.5) & (kept[:, 2] > -1.5)]
        assert bool(np.all(ahead[:, 0] < 2.5)) == is_hidden
