"""Closed-loop flights with the planner."""

import csv
import dataclasses
import gc
import json
import signal
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from aero_planner import PlannerConfig
from aero_viz.errors import UserError
from aero_viz.flight import FlightBatch, FlightRules, StateNoise, VehicleModel, fly
from aero_viz.scenes import SCENES, World, scene
from aero_viz.sensors import LidarModel

CONFIG = PlannerConfig.preset("fast-cpu")
LIDAR = LidarModel("small", points_per_sweep=2000)
SHORT = FlightRules(time_limit=1.0)


@pytest.fixture(scope="module")
def sparse() -> World:
    return scene("forest", seed=3, count=20)


def rows(path):
    with open(path, encoding="utf-8") as file:
        return list(csv.reader(file))


def test_flight_through_a_sparse_forest_arrives_and_reports(sparse, tmp_path):
    result = fly(sparse, config=CONFIG, seed=1, lidar=LIDAR, trajectory=tmp_path / "t.csv")
    assert result.arrived and result.reason == "arrived"
    assert (result.seed, result.scene, result.config) == (1, sparse.name, "fast-cpu")
    assert result.min_clearance and result.mean_clearance and result.plan_ms_median
    assert 44.0 <= result.length_m < 60.0 and 0.25 <= result.min_clearance <= result.mean_clearance <= 2.5
    assert result.mean_speed == pytest.approx(result.length_m / result.flight_time_s)
    assert json.loads(json.dumps(result.to_dict())) == dataclasses.asdict(result)

    header, *table = rows(tmp_path / "t.csv")
    assert header == ["t", "x", "y", "z", "vx", "vy", "vz"]
    t, p, v = np.split(np.array(table, dtype=float), [1, 4], axis=1)
    assert t[0] == 0.0 and t[-1] == pytest.approx(result.flight_time_s)
    np.testing.assert_array_equal(p[0], sparse.start)
    assert np.linalg.norm(p[-1] - sparse.goal) <= 1.0 and sparse.distance(p).min() >= result.min_clearance - 1e-4
    # The metrics follow from the file: the path through its positions, the jerk from its velocities.
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).sum() == pytest.approx(result.length_m, rel=1e-4)
    assert np.linalg.norm(v, axis=1).max() == pytest.approx(result.max_speed, abs=1e-4)
    assert np.linalg.norm(v[-1]) == pytest.approx(result.end_speed, abs=1e-4)
    mean_acceleration = np.vstack([np.zeros(3), np.diff(v, axis=0) / 0.02])
    smoothness = np.sum(np.diff(mean_acceleration, axis=0) ** 2) / 0.02
    assert smoothness == pytest.approx(result.smoothness, rel=1e-2)


def test_same_seed_same_flight_bit_for_bit(sparse, tmp_path, device):
    results = [
        fly(sparse, config=CONFIG, device=device, seed=seed, lidar=LIDAR, rules=SHORT, trajectory=tmp_path / f"{i}.csv")
        for i, seed in enumerate((7, 7, 8))
    ]
    first, repeated, different = (dataclasses.replace(result, plan_ms_median=None) for result in results)
    assert first == repeated and first.reason == "timeout"
    assert first.length_m != different.length_m
    assert (tmp_path / "0.csv").read_bytes() == (tmp_path / "1.csv").read_bytes()


def panels() -> World:
    """Tilted triangles on the way from start to goal."""
    rng = np.random.default_rng(4)
    corners = rng.uniform((4.0, -4.0, 0.0), (40.0, 4.0, 4.0), (25, 1, 3)) + rng.uniform(-1.0, 1.0, (25, 3, 3))
    return World("panels", np.array([0.0, 0, 2]), np.array([45.0, 0, 2]), triangles=corners.reshape(25, 9))


def test_a_batch_flies_as_single_flights(device):
    worlds = [
        panels(),
        scene("forest", seed=1, count=30),
        scene("inclines", seed=2, count=60),
        scene("verticals", seed=3, count=60),
    ]
    together = FlightBatch(worlds, config=CONFIG, device=device, seed=10, lidar=LIDAR, rules=SHORT)
    results = together.run()
    for b, world in enumerate(worlds):
        alone = FlightBatch([world], config=CONFIG, device=device, seed=10 + b, lidar=LIDAR, rules=SHORT)
        result = alone.run()[0]
        # Float32 on one device in the same order: equal to the last bit.
        np.testing.assert_array_equal(
            alone.simulator.vehicle.position.numpy()[0], together.simulator.vehicle.position.numpy()[b]
        )
        assert dataclasses.replace(result, plan_ms_median=None) == dataclasses.replace(results[b], plan_ms_median=None)


def test_every_scene_flies_in_one_batch(device):
    scenes = [scene(name, seed=1) for name in SCENES]
    worlds = [world.with_goal(world.goal) for world in scenes]  # a batch flies no missions
    rules = dataclasses.replace(SHORT, time_limit=0.1)
    results = FlightBatch(worlds, config=CONFIG, device=device, lidar=LIDAR, rules=rules).run()
    assert [(result.scene, result.reason) for result in results] == [(world.name, "timeout") for world in worlds]


REAL = {
    "vehicle": VehicleModel(drag=0.2, gust_speed=1.0, latency=0.01, thrust_lag=0.03, rate_lag=0.02),
    "noise": StateNoise(position=0.03, velocity=0.05, attitude=0.5),
    "rules": dataclasses.replace(SHORT, ticks_per_plan=5),
}


def test_a_batch_with_every_disturbance_flies_as_single_flights(sparse, device):
    worlds = [sparse, scene("inclines", seed=2, count=60)]
    lidar = dataclasses.replace(LIDAR, sweep_loss=0.4)
    together = FlightBatch(worlds, config=CONFIG, device=device, seed=3, lidar=lidar, **REAL)
    together.run()
    for b, world in enumerate(worlds):
        alone = FlightBatch([world], config=CONFIG, device=device, seed=3 + b, lidar=lidar, **REAL)
        alone.run()
        for holder in ("vehicle", "estimate"):
            a, t = (getattr(batch.simulator, holder).position.numpy() for batch in (alone, together))
            np.testing.assert_array_equal(a[0], t[b])


def test_a_disturbed_flight_still_arrives(sparse):
    rules = dataclasses.replace(REAL["rules"], time_limit=60.0)
    result = fly(sparse, config=CONFIG, seed=1, lidar=LIDAR, **(REAL | {"rules": rules}))
    assert result.arrived


def test_ten_plans_per_second_fly_their_controls_at_fifty():
    world = World("empty", np.zeros(3), np.array([30.0, 0, 0]))
    batch = FlightBatch([world], config=CONFIG, lidar=LIDAR, rules=REAL["rules"])
    step = CONFIG.sampling.dt
    ticks = []
    for tick in range(10):
        batch.step()
        plan = batch.planner.command.numpy()[0].astype(float)
        ticks.append(int(batch.planner.history().arrays["tick"][0]))
        phase = tick % 5 * 0.02 / step
        i = int(phase)
        expected = plan[i] + (phase - i) * (plan[i + 1] - plan[i])
        np.testing.assert_allclose(batch.simulator.vehicle.control.numpy()[0], expected, atol=1e-5)
    assert ticks == [1] * 5 + [2] * 5


def test_configurations_that_differ_in_dt_need_a_plan_per_tick(sparse):
    configs = [CONFIG, CONFIG.replace({"sampling.dt": 0.04})]
    with pytest.raises(ValueError, match=r"sampling\.dt"):
        FlightBatch([sparse, sparse], config=configs, lidar=LIDAR, rules=REAL["rules"])


def test_progress_counts_flights(sparse):
    near = World("near", np.zeros(3), np.array([0.5, 0, 0]))
    calls = []
    FlightBatch([sparse, near], config=CONFIG, lidar=LIDAR, rules=FlightRules(time_limit=0.09)).run(
        progress=lambda *call: calls.append(call)
    )
    assert [finished for finished, _, _ in calls] == [1] * 5 + [2]
    np.testing.assert_allclose([time for *_, time in calls], 0.02 * np.arange(6))


def test_ctrl_c_in_the_last_tick_is_not_lost(sparse):
    batch = FlightBatch([sparse], config=CONFIG, lidar=LIDAR, rules=FlightRules(time_limit=0.1))

    def press_at_the_end(finished, total, simulated):
        if finished == total:
            signal.raise_signal(signal.SIGINT)

    results = batch.run(progress=press_at_the_end)
    assert batch.interrupted and [result.reason for result in results] == ["timeout"]


def test_ctrl_c_keeps_what_is_finished(sparse):
    near = World("near", np.zeros(3), np.array([0.5, 0, 0]))
    batch = FlightBatch([sparse, near], config=CONFIG, lidar=LIDAR)

    def press_at_a_tenth(finished, total, simulated):
        if simulated >= 0.1 and not batch.interrupted:
            signal.raise_signal(signal.SIGINT)

    results = batch.run(progress=press_at_a_tenth)
    assert batch.interrupted and [result.reason for result in results] == [None, "arrived"]
    assert results[0].flight_time_s == pytest.approx(0.1)
    # The batch can continue.
    batch.step()
    assert batch.simulator.time == pytest.approx(0.12)


def arrays_of(owner, seen):
    """Yield the Warp arrays that `owner` refers to through lists, dicts and objects of this project."""
    if id(owner) in seen:
        return
    seen.add(id(owner))
    if isinstance(owner, wp.array):
        yield owner
    elif isinstance(owner, (list, tuple, dict, SimpleNamespace)) or type(owner).__module__.startswith("aero_"):
        content = owner if isinstance(owner, (list, tuple, dict)) else getattr(owner, "__dict__", {})
        for item in list(content.values() if isinstance(content, dict) else content):
            yield from arrays_of(item, seen)


def device_bytes(count: int, world: World, config: PlannerConfig | None, lidar: LidarModel | None) -> int:
    """Return the size of the arrays of a batch; with one thread, the CPU has the memory layout of a GPU."""
    batch = FlightBatch([world] * count, config=config, lidar=lidar, threads=1)
    total = end = 0
    for first, last in sorted({(a.ptr, a.ptr + a.capacity) for a in arrays_of(batch, set()) if a.ptr}):
        total, end = total + max(0, last - max(first, end)), max(end, last)  # shared memory counts once
    return total


def test_memory_grows_linearly_with_the_batch(sparse):
    one, two, five = (device_bytes(count, sparse, CONFIG, LIDAR) for count in (1, 2, 5))
    assert five - two == pytest.approx(3 * (two - one), rel=1e-3)
    # Thirty sweeps for the planner, as they came and by shell, and the one in progress are part of it.
    larger = dataclasses.replace(LIDAR, points_per_sweep=LIDAR.points_per_sweep + 1000)
    growth = device_bytes(2, sparse, CONFIG, larger) - device_bytes(1, sparse, CONFIG, larger)
    assert growth - (two - one) == pytest.approx(1000 * (31 * 12 + 30 * (4 + 12)), abs=64)


def test_memory_of_a_batch_does_not_wait_for_the_garbage_collector(sparse, device):
    gc.disable()
    try:
        batch = FlightBatch([sparse] * 2, config=CONFIG, lidar=LIDAR, rules=FlightRules(time_limit=0.1), device=device)
        batch.run()
        planner, simulator = batch.planner, batch.simulator
        arrays = (planner.workspace.sample_positions, planner.inputs.position, simulator.lidar.points, simulator.record)
        held = [weakref.ref(array) for array in arrays]
        planner.close()
        del batch, planner, simulator, arrays
        assert [reference() for reference in held] == [None] * 4
    finally:
        gc.enable()


def test_one_configuration_per_flight(sparse):
    slow, fast = (CONFIG.replace({"vehicle.speed_limit": speed}) for speed in (2.0, 7.0))
    results = FlightBatch([sparse, sparse], config=[slow, fast], lidar=LIDAR, rules=FlightRules(time_limit=2.0)).run()
    assert results[0].max_speed < 3.0 < results[1].max_speed
    assert [result.config for result in results] == ["custom", "fast-cpu"]


def test_speed_replaces_the_limit(sparse):
    result = fly(sparse, config=CONFIG, lidar=LIDAR, speed=2.0, rules=FlightRules(time_limit=2.0))
    assert 1.0 < result.max_speed < 3.0


def test_collision_at_the_start_plans_nothing():
    inside = World("inside", np.zeros(3), np.array([9.0, 0, 0]), spheres=np.array([[0.0, 0.0, 0.0, 1.0]]))
    result = fly(inside, config=CONFIG, lidar=LIDAR)
    assert (result.reason, result.flight_time_s, result.mean_speed, result.plan_ms_median) == (
        "collision",
        0.0,
        0.0,
        None,
    )


def test_empty_world_has_no_clearance():
    result = fly(World("empty", np.zeros(3), np.array([6.0, 0, 0])), config=CONFIG, lidar=LIDAR)
    assert result.arrived and result.min_clearance is None and result.mean_clearance is None
    json.dumps(result.to_dict(), allow_nan=False)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"speed": -1.0}, "speed_limit"),
        ({"device": "cuda:99"}, "cuda:99"),
        ({"rules": FlightRules(period=0.2)}, "less than the tick"),
    ],
)
def test_invalid_options_are_refused_in_one_sentence(sparse, options, expected):
    with pytest.raises(UserError, match=expected):
        fly(sparse, config=CONFIG, lidar=LIDAR, **options)


def test_trajectory_that_cannot_be_written_is_named(sparse, tmp_path):
    with pytest.raises(UserError, match="no_folder"):
        fly(sparse, config=CONFIG, lidar=LIDAR, trajectory=tmp_path / "no_folder" / "t.csv")
    if Path("/dev/full").exists():
        with pytest.raises(UserError, match="Cannot write the trajectory /dev/full: No space left on device"):
            fly(sparse, config=CONFIG, lidar=LIDAR, trajectory="/dev/full")


@pytest.mark.parametrize("options", [{"config": []}, {"config": [CONFIG] * 3}, {"config_names": ["one"]}])
def test_configurations_and_names_must_be_one_per_flight(sparse, options):
    with pytest.raises(ValueError, match=r"were given for 2 flights; give one for each"):
        FlightBatch([sparse, sparse], **({"config": CONFIG, "lidar": LIDAR} | options))


def test_no_worlds():
    with pytest.raises(ValueError, match="no worlds"):
        FlightBatch([])


def test_timing_the_stages_does_not_change_the_flights(device: str):
    world = scene("forest", seed=1, count=5)
    batches = [FlightBatch([world] * 2, config=CONFIG, lidar=LIDAR, device=device, seed=3) for _ in range(2)]
    for _ in range(8):
        batches[0].step()
    stages = batches[1].time_stages(6)
    for _ in range(2):
        batches[1].step()
    assert {"planner", "vehicle", "lidar", "sweeps", "planner.partition", "planner.clearance"} <= set(stages)
    first, second = (batch.simulator.vehicle.position.numpy() for batch in batches)
    np.testing.assert_array_equal(first, second)


def test_a_flight_of_a_batch_flies_on_in_another_world(sparse, device):
    seeds = [3, 4]
    batch = FlightBatch([sparse, sparse], config=CONFIG, lidar=LIDAR, rules=SHORT, seed=seeds, device=device)
    for _ in range(10):
        batch.step()
    position = batch.simulator.vehicle.position.numpy()[0].astype(float)
    closed = dataclasses.replace(sparse, spheres=np.vstack([sparse.spheres, [*position, 0.5]]))
    with pytest.raises(ValueError, match="1 worlds were given for 2 flights"):
        batch.set_worlds([closed])
    batch.set_worlds([closed, sparse])
    first, second = batch.run()
    assert (first.reason, second.reason) == ("collision", "timeout") and first.flight_time_s == pytest.approx(0.22)
    alone = FlightBatch([sparse], config=CONFIG, lidar=LIDAR, rules=SHORT, seed=[4], device=device).run()[0]
    assert second.length_m == alone.length_m


def test_seeds_may_be_numbers_of_numpy(sparse: World):
    results = FlightBatch(
        [sparse] * 2, config=CONFIG, lidar=LIDAR, rules=FlightRules(time_limit=0.02), seed=np.int64(2)
    ).run()
    assert [result.seed for result in results] == [2, 3]
    assert json.dumps(dataclasses.asdict(results[0]))


def test_a_flight_needs_a_world_not_its_name():
    with pytest.raises(UserError, match="world is 'forest'; it must be a World"):
        fly("forest")  # pyright: ignore[reportArgumentType]
