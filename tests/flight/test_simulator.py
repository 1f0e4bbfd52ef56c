"""Outcomes and metrics of scripted flights with known answers."""

import dataclasses
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_viz.flight import FlightRules, Simulator, VehicleModel
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

G = 9.81
HOVER = (G, 0.0, 0.0, 0.0)
LIDAR = LidarModel("small", points_per_sweep=100)


def world(goal=(20.0, 0.0, 2.0), **tables) -> World:
    tables = {key: np.array(rows, dtype=float) for key, rows in tables.items()}
    return World("test", np.array([0.0, 0.0, 2.0]), np.array(goal), mission=None, **tables)


def simulate(worlds, *, lidar: Any = LIDAR, **rules: Any) -> Simulator:
    worlds = [worlds] if isinstance(worlds, World) else worlds
    model = VehicleModel(thrust_min=0.0)
    return Simulator(worlds, lidar=lidar, vehicle=model, rules=FlightRules(**rules), seeds=range(len(worlds)))


def fly(simulator: Simulator, command, ticks: int) -> None:
    commands = wp.array([[command]] * len(simulator.outcomes()), dtype=wp.vec4)
    for _ in range(ticks):
        simulator.advance(commands)


def set_velocity(simulator: Simulator, velocity) -> None:
    simulator.vehicle.velocity.assign(np.array([velocity] * len(simulator.outcomes()), dtype=np.float32))


def test_a_start_inside_an_obstacle_is_an_immediate_collision():
    simulator = simulate(world(spheres=[[0.0, 0.0, 2.5, 1.0]]))
    assert simulator.outcomes() == ["collision"]
    record = simulator.records()[0]
    assert record["ticks"] == 0 and record["clearance_min"] == pytest.approx(-0.5)
    fly(simulator, (16.0, 0.0, 0.0, 0.0), 3)
    np.testing.assert_array_equal(simulator.vehicle.position.numpy()[0], [0.0, 0.0, 2.0])


@pytest.mark.parametrize(("gap", "outcome"), [(0.249, "collision"), (0.251, None)])
def test_collision_is_closer_than_the_radius(gap, outcome):
    assert simulate(world(spheres=[[0.0, 1.0 + gap, 2.0, 1.0]])).outcomes() == [outcome]


def test_collision_with_a_wall_happens_in_the_tick_that_reaches_it():
    # At 5 m/s the centre is 0.25 m in front of the wall at x = 3 after 0.55 s, in tick 28.
    simulator = simulate(world(boxes=[[3.5, 0.0, 2.0, 1.0, 9.0, 9.0, 0.0]]))
    set_velocity(simulator, (5.0, 0.0, 0.0))
    fly(simulator, HOVER, 27)
    assert simulator.outcomes() == [None]
    fly(simulator, HOVER, 1)
    assert simulator.outcomes() == ["collision"] and simulator.records()[0]["ticks"] == 28


def test_a_fast_drone_does_not_jump_over_a_wire():
    # 18 m/s are 0.36 m in a tick; both ends of the tick are more than 0.25 m from the wire's surface.
    wire = [[2.0, 0.24, 0.0, 0.0, 0.0, 1.0, 0.01, 9.0]]
    simulator = simulate(world(cylinders=wire))
    set_velocity(simulator, (18.0, 0.0, 0.0))
    fly(simulator, HOVER, 10)
    assert simulator.outcomes() == ["collision"]


def test_arrival_within_one_metre():
    simulator = simulate(world(goal=(4.98, 0.0, 2.0)))
    set_velocity(simulator, (4.0, 0.0, 0.0))
    fly(simulator, HOVER, 80)
    record = simulator.records()[0]
    assert simulator.outcomes() == ["arrived"] and record["ticks"] == 50
    assert record["length"] == pytest.approx(4.0, rel=1e-5) and record["speed_max"] == pytest.approx(4.0)


def test_a_drone_that_does_not_move_by_a_metre_in_five_seconds_stalls():
    simulator = simulate(world())
    set_velocity(simulator, (0.1, 0.0, 0.0))
    fly(simulator, HOVER, 249)
    assert simulator.outcomes() == [None]
    fly(simulator, HOVER, 1)
    assert simulator.outcomes() == ["stall"]


@pytest.mark.parametrize("velocity", [(0.25, 0.0, 0.0), (0.0, 0.25, 0.0), (-0.25, 0.0, 0.0)])
def test_slow_motion_in_any_direction_is_not_a_stall(velocity: tuple[float, float, float]):
    """The way out of a dead end leads away from the goal."""
    simulator = simulate(world(), time_limit=12.0)
    set_velocity(simulator, velocity)
    fly(simulator, HOVER, 600)
    assert simulator.outcomes() == ["timeout"] and simulator.records()[0]["ticks"] == 600


def test_a_drone_that_returns_to_where_it_was_within_five_seconds_stalls():
    simulator = simulate(world())
    for velocity in (0.25, -0.25):
        set_velocity(simulator, (velocity, 0.0, 0.0))
        fly(simulator, HOVER, 125)
    assert simulator.outcomes() == ["stall"]


def test_falling_without_ground_leaves_the_bounds():
    simulator = simulate(world())
    fly(simulator, (0.0, 0.0, 0.0, 0.0), 100)
    record = simulator.records()[0]
    assert simulator.outcomes() == ["out_of_bounds"]
    assert record["ticks"] == np.ceil(np.sqrt(2 * 10.0 / G) / 0.02)  # 10 m below start and goal
    assert simulator.vehicle.position.numpy()[0, 2] < simulator.vehicle.position_before.numpy()[0, 2]


def test_metrics_of_a_straight_climb():
    # Thrust 2 g: a = g upward from the first tick on. Smoothness: one step of the mean acceleration, (0 -> g)^2 / dt.
    simulator = simulate(world(boxes=[[0.0, 0.0, -0.5, 99.0, 99.0, 1.0, 0.0]]))
    simulator.vehicle.control.assign(np.array([[G, 0, 0, 0]], dtype=np.float32))
    fly(simulator, (16.0, 0.0, 0.0, 0.0), 25)
    a, record = 16.0 - G, simulator.records()[0]
    assert record["length"] == pytest.approx(0.5 * a * 0.5**2, rel=1e-4)
    assert record["speed_max"] == pytest.approx(0.5 * a, rel=1e-4)
    assert record["smoothness"] == pytest.approx(a**2 / 0.02, rel=1e-3)
    assert record["clearance_min"] == pytest.approx(2.0)
    steps = 0.005 * np.arange(1, 101)
    heights = np.concatenate([[2.0] * 4, 2.0 + 0.5 * a * steps**2])
    assert record["clearance_sum"] / record["clearance_count"] == pytest.approx(heights.mean(), rel=1e-4)


def test_finished_flights_do_not_stop_the_others():
    blocked = world(boxes=[[3.5, 0.0, 2.0, 1.0, 9.0, 9.0, 0.0]])
    simulator = simulate([world(), blocked, world(goal=(2.98, 0.0, 2.0))])
    set_velocity(simulator, (5.0, 0.0, 0.0))
    fly(simulator, HOVER, 100)
    assert simulator.outcomes() == [None, "collision", "arrived"]
    np.testing.assert_allclose(simulator.vehicle.position.numpy()[:, 0], [10.0, 2.8, 2.0], atol=1e-3)


def test_heading_is_toward_the_goal():
    q = simulate(world(goal=(0.0, 10.0, 2.0))).vehicle.quaternion.numpy()[0]
    np.testing.assert_allclose(q, [np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], atol=1e-6)


def test_sweeps_are_complete_every_fifth_tick():
    simulator = simulate(world())
    commands = wp.array([[HOVER]], dtype=wp.vec4)
    parts = [simulator.advance(commands) for _ in range(10)]
    assert parts == [(k // 5, k % 5 * 20, k % 5 * 20 + 20) for k in range(10)]


def test_a_sweep_ends_with_the_tick_in_which_its_time_is_over():
    """A camera at 30 Hz, whose images take one or two ticks of 20 ms; none of their rays is lost."""
    simulator = simulate(world(), lidar=dataclasses.replace(LIDAR, sweep_rate=30.0))
    commands = wp.array([[HOVER]], dtype=wp.vec4)
    parts = [simulator.advance(commands) for _ in range(15)]
    assert [k + 1 for k, (_, _, end) in enumerate(parts) if end == 100] == [2, 4, 5, 7, 9, 10, 12, 14, 15]
    assert [sweep for sweep, _, end in parts if end == 100] == list(range(9))
    for (_, _, end), (_, first, _) in pairwise(parts):
        assert first == end % 100


def test_a_sweep_takes_at_least_a_tick():
    with pytest.raises(ValueError, match=r"a sweep takes 0.1 s, less than the tick of 0.2 s"):
        simulate(world(), period=0.2)


def test_moving_the_goal_resumes_an_arrived_flight():
    simulator = simulate(world(goal=(0.5, 0.0, 2.0)))
    assert simulator.outcomes() == ["arrived"]
    simulator.set_goal([[0.0, 30.0, 2.0]])
    assert simulator.outcomes() == [None]
    assert simulator.records()[0]["progress_tick"] == simulator.tick


def test_the_time_limit_runs_from_the_goal_that_was_set_last():
    simulator = simulate(world(), time_limit=1.0)
    fly(simulator, HOVER, 40)
    simulator.set_goal([[0.0, 30.0, 2.0]])
    fly(simulator, HOVER, 49)
    assert simulator.outcomes() == [None]
    fly(simulator, HOVER, 1)
    assert simulator.outcomes() == ["timeout"] and simulator.records()[0]["ticks"] == 90
    simulator.set_goal([[20.0, 0.0, 2.0]])
    fly(simulator, HOVER, 49)
    assert simulator.outcomes() == [None]
    fly(simulator, HOVER, 1)
    assert simulator.outcomes() == ["timeout"] and simulator.records()[0]["ticks"] == 140


def test_restored_simulator_continues_bit_for_bit():
    simulator = simulate(world(spheres=[[5.0, 2.0, 3.0, 1.0]]))
    fly(simulator, (10.0, 0.2, 0.3, 0.1), 13)
    checkpoint = simulator.checkpoint()

    def fly_on():
        fly(simulator, (9.0, -0.2, 0.1, 0.0), 12)
        return [
            array.numpy().copy() for array in (simulator.vehicle.position, simulator.lidar.points, simulator.record)
        ]

    first = fly_on()
    fly(simulator, HOVER, 5)
    simulator.restore(checkpoint)
    assert simulator.tick == 13
    for a, b in zip(first, fly_on(), strict=True):
        assert a.tobytes() == b.tobytes()


def test_rules_must_be_positive():
    with pytest.raises(ValueError, match="radius"):
        FlightRules(radius=0.0)


MOVERS = {
    "cylinders": [[3.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.4, 5.0], [4.0, 2.0, 0.0, 0.0, 0.6, 0.8, 0.3, 6.0]],
    "motion": [[-1.6, 0.3, 2.5], [0.5, -1.5, 1.0]],
}


def distance_at(time: float, point) -> float:
    """Distance to MOVERS [m], written from the definition: along the velocity for the span, and back."""
    distances = []
    for row, (x, y, span) in zip(np.array(MOVERS["cylinders"]), MOVERS["motion"], strict=True):
        speed, axis = np.hypot(x, y), row[3:6]
        leg, gone = divmod(speed * time, span)
        gone = gone if leg % 2 == 0 else span - gone
        relative = np.asarray(point, dtype=float) - row[:3] - gone / speed * np.array([x, y, 0.0])
        along = relative @ axis
        out = np.linalg.norm(relative - along * axis) - row[6]
        over = abs(along - 0.5 * row[7]) - 0.5 * row[7]
        distances.append(np.hypot(max(out, 0.0), max(over, 0.0)) + min(max(out, over), 0.0))
    return min(distances)


def test_clearance_is_that_from_where_obstacles_are_at_each_integration_step():
    simulator = simulate(world(boxes=[[0, 0, -50, 9, 9, 1, 0]], **MOVERS), radius=0.01)
    steps = simulator.vehicle.trail.shape[1]
    nearest, total = np.inf, steps * distance_at(0.0, [0.0, 0.0, 2.0])
    for tick in range(1, 201):
        fly(simulator, HOVER, 1)
        times = 0.02 * (tick - 1) + 0.02 / steps * np.arange(1, steps + 1)
        trail = simulator.vehicle.trail.numpy()[0]
        distances = [distance_at(time, point) for time, point in zip(times, trail, strict=True)]
        nearest, total = min(nearest, *distances), total + sum(distances)
    record = simulator.records()[0]
    assert record["clearance_min"] == pytest.approx(nearest, abs=1e-4)
    assert record["clearance_sum"] == pytest.approx(total, rel=1e-5)


def test_an_obstacle_runs_into_a_hovering_drone():
    pole = {"cylinders": [[2.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.25, 5.0]], "motion": [[-1.0, 0.0, 3.0]]}
    simulator = simulate([world(**pole), world(cylinders=pole["cylinders"])])
    fly(simulator, HOVER, 120)
    assert simulator.outcomes() == ["collision", None]
    assert simulator.records()["ticks"].tolist() == [75 + 1, 120]  # 1.5 m at 1 m/s; contact is closer than the radius


@pytest.mark.parametrize("limit", [0.1, 0.2, 0.3, 0.31, 1.4])
@pytest.mark.parametrize("rule", ["time_limit", "stall_time"])
def test_a_time_limit_ends_a_flight_at_its_tick(rule: str, limit: float):
    simulator = simulate(world(), **{rule: limit})
    fly(simulator, HOVER, 80)
    assert simulator.outcomes() == ["timeout" if rule == "time_limit" else "stall"]
    assert simulator.records()[0]["ticks"] == math.ceil(round(limit / 0.02, 6))
