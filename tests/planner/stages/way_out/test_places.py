"""Tabu memory of local minima: which places are remembered, and what they change."""

from typing import Any

import numpy as np
import pytest

from aero_planner import Goal, Plan, Planner, VehicleState
from tests.planner import reference
from tests.planner.cases import config_of, exact, level_case, random_case, shell


def test_a_slow_drone_that_makes_progress_remembers_nothing(device: str):
    case, config = level_case(), config_of(vehicle__speed_limit=1.0)
    planner = Planner(config, device=device)
    for k in range(20):
        position = np.array([0.09 * k, 0.0, 0.0])  # 0.9 m/s
        state = VehicleState(position, case.velocity, case.quaternion, case.acceleration, time=0.1 * k)
        planner.plan(state, Goal(case.goal), case.points)
    assert planner.history().arrays["place_count"][0] == 0


def test_a_drone_without_progress_remembers_where_it_was(device: str):
    config = config_of(way_out__patience=0.5)
    case, planner = level_case(), Planner(config, device=device)
    for k in range(13):
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=0.1 * k)
        planner.plan(state, Goal(case.goal), case.points)
    history = planner.history().arrays
    assert history["place_count"][0] == 2
    np.testing.assert_array_equal(history["places"][0, :2], np.zeros((2, 3)))
    planner.plan(case.state, Goal([0.0, 20.0, 0.0]), case.points)
    assert planner.history().arrays["place_count"][0] == 0


ONLY_ESCAPE: dict[str, Any] = {"costs__q_speed": 0.0, "costs__q_blocked": 0.0, "costs__q_thrust_jump": 0.0}


@pytest.mark.parametrize("radius", [4.0, 6.0])
def test_rollouts_that_end_near_places_without_progress_cost_more(device: str, radius: float):
    planner = Planner(config_of(way_out__radius=radius, stages__active="way_out", **ONLY_ESCAPE), device=device)
    case = level_case(3.0)

    def plan(time: float) -> Plan:
        state = VehicleState(case.position, case.velocity, case.quaternion, case.acceleration, time=time)
        return planner.plan(state, Goal(case.goal), case.points)

    for k in range(6):
        plan(0.1 * k)
    last = plan(0.6)
    history = planner.history().arrays
    places = history["places"][0, : history["place_count"][0]].astype(np.float64)
    ends = last.positions[:, -1].astype(np.float64)
    nearest = float(history["place_nearest"][0])
    expected = [reference.J_escape(p, places, nearest, case.goal, planner.config) for p in ends]
    np.testing.assert_allclose(last.stage2_cost - last.goal_cost, expected, rtol=1e-4, atol=0.02)
    full = [reference.J_escape(p, places, 0.0, case.goal, planner.config) for p in ends]
    assert len(places) >= 2 and max(expected) > 100.0
    assert nearest == 3.0 and sum(expected) < 0.8 * sum(full), "ends that are nearer to the goal cost less"


@pytest.mark.parametrize("aside", [0.0, 1.0])
def test_a_drone_that_has_passed_its_goal_comes_back(device: str, aside: float):
    """It makes no progress meanwhile, and must not keep away from the places of its way back. Then it stays."""
    config = config_of(vehicle__speed_limit=5.0, sampling__samples=64, sampling__steps=25)
    planner, goal, dt = Planner(config, device=device, seed=1), np.array([1.5, 0.0, 3.0]), config.sampling.dt
    position, velocity, attitude = np.array([0.0, aside, 3.0]), np.array([5.0, 0.0, 0.0]), np.array([1.0, 0, 0, 0])
    distances = []
    for k in range(300):
        plan = planner.plan(
            VehicleState(position, velocity, attitude, time=k * dt), Goal(goal), np.full((64, 3), 40.0, np.float32)
        )
        x = reference.roll_out(position, attitude, velocity, plan.command[:1].astype(np.float64), config)
        position, velocity, attitude = x.p[-1], x.v[-1], x.q[-1]
        distances.append(np.linalg.norm(position - goal))
    assert max(distances) > 1.0 and max(distances[130:]) < 0.3


def test_slow_drones_spread_their_anchors(device: str):
    planner = Planner(config_of(way_out__spread=2.0), device=device)

    def angles(speed: float) -> tuple[float, float]:
        """Return the angles from the middle anchor to those beside and above it [deg]."""
        case = random_case(0, count=0)
        case.velocity, case.goal = exact([speed, 0, 0]), case.beside(30, 0, 0)
        d = case.plan(planner).initial_endpoints[[7, 6, 12]] - case.position
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        beside, above = np.degrees(np.arccos(d[1:] @ d[0]))
        return float(beside), float(above)

    assert angles(2.9) == pytest.approx((36.0, 45.0), abs=0.01)
    assert angles(3.1) == pytest.approx((18.0, 18.0), abs=0.01)


@pytest.mark.parametrize(
    ("changes", "speed", "gets_stuck"),
    [
        ({}, 0.0, True),
        ({"way_out__radius": 1.0, "way_out__patience": 0.3}, 2.0, True),
        ({"way_out__q_escape": 0.0}, 0.0, False),
        ({"stages__active": "stop_proof, memory"}, 0.0, False),
        ({}, 4.0, False),
    ],
)
def test_guides_of_a_slow_drone_that_is_stuck_end_before_what_is_seen(
    device: str, changes: dict[str, Any], speed: float, gets_stuck: bool
):
    config, case = config_of(**changes), random_case(2, count=0, tilt=0.0)
    case.velocity = np.array([speed, 0.0, 0.0])
    planner, directions = Planner(config, device=device), shell(np.zeros(3), 1.0, count=60000)
    # Nothing in one quarter around the drone, walls in the others.
    quarters = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) * 2 / np.pi).astype(int)
    radii = np.array((30.0, 0.7, 1.3, 2.0))[quarters]
    points = (case.position + radii[:, None] * directions).astype(np.float32)
    full = reference.lookahead(float(np.linalg.norm(case.goal - case.position)), config)
    were_stuck, lengths = [], np.zeros(15)
    for k in range(14):
        state = VehicleState(case.position, case.velocity, case.quaternion, time=0.1 * k)
        plan = planner.plan(state, Goal(case.goal), points)
        count = planner.history().arrays.get("place_count", np.zeros(1))[0]
        were_stuck.append(count > 0 and gets_stuck)
        offsets = plan.anchors[:15].astype(np.float64) - case.position
        in_body = offsets @ reference.rotation(reference.unit(case.quaternion))
        rows, columns, border = reference.cell_indices(in_body, *plan.fine_range.shape)
        free = plan.fine_range[rows, columns]
        expected = [reference.clipped_length(full, r) if were_stuck[-1] else full for r in free]
        lengths = np.linalg.norm(offsets, axis=1)
        np.testing.assert_allclose(lengths[border > 1e-4], np.asarray(expected)[border > 1e-4], atol=2e-5)
    assert not were_stuck[0] and were_stuck[-1] == gets_stuck
    assert not gets_stuck or len(set(np.round(lengths, 3))) > 2  # the shortest, at a wall, and of full length


@pytest.mark.parametrize("sides", [11, 12])
def test_a_goal_behind_a_surface_from_all_sides_has_no_way_to_it(device: str, sides: int):
    """Then no place is remembered, and the drone flies to where it was nearest to the goal."""
    case, config = level_case(), config_of(vehicle__speed_limit=1.0)
    planner, goal = Planner(config, device=device), np.array([0.0, 0.0, 2.0])
    angles = np.radians(np.arange(0.0, 360.0, 2.0))
    ring = np.stack((np.cos(angles), np.sin(angles), np.zeros(180)), axis=1)
    tower = np.concatenate([1.5 * ring + (0.0, 0.0, height) for height in np.arange(0.0, 4.0, 0.03)])
    for k in range(5 * sides):
        angle = np.radians(15.0 + 30.0 * (k // 5))
        position = goal + (3.0 if k < 5 else 3.5) * np.array([np.cos(angle), np.sin(angle), 0.0])
        state = VehicleState(position, np.zeros(3), case.quaternion, np.zeros(3), time=0.1 * k)
        planner.plan(state, Goal(goal), tower.astype(np.float32))
        places = planner.history().arrays
        assert (int(places["goal_hidden"][0]) & 0xFFF).bit_count() == k // 5 + 1
    assert (places["place_count"][0] == 0) == (sides == 12)  # pyright: ignore[reportPossiblyUnboundVariable]
    nearest = goal + 3.0 * np.array([np.cos(np.radians(15.0)), np.sin(np.radians(15.0)), 0.0])
    np.testing.assert_allclose(planner.workspace.goal.numpy()[0], nearest if sides == 12 else goal, atol=1e-5)
    planner.plan(case.state, Goal([0.0, 20.0, 0.0]), case.points)
    assert not planner.history().arrays["goal_hidden"].any(), "another goal is looked at anew"
