"""Which sweeps the planner of a flight remembers."""

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules, FlightSource
from aero_viz.flight.memory import MOST_SWEEPS, remembered_sweeps
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel
from aero_viz.session.session import Session

LIDAR = LidarModel("small", points_per_sweep=500)
QUICK = PlannerConfig.preset("fast-cpu").replace({"sampling.samples": 8})
SLOW, FAST = (QUICK.replace({"vehicle.speed_limit": limit}) for limit in (1.0, 7.0))
RULES = FlightRules(time_limit=4.0, ticks_per_plan=5)


@pytest.fixture(scope="module")
def world() -> World:
    return scene("forest", seed=3, count=20)


@pytest.mark.parametrize(
    ("memory", "rate", "sweeps"), [(3.0, 10.0, 30), (1.0, 10.0, 10), (0.1, 10.0, 1), (9.0, 20.0, MOST_SWEEPS)]
)
def test_sweeps_are_counted_back_from_one_that_is_complete(memory: float, rate: float, sweeps: int):
    assert remembered_sweeps(memory, LidarModel("any", points_per_sweep=500, sweep_rate=rate)) == sweeps


def test_the_memory_follows_the_configuration_from_tick_to_tick(world: World):
    source = FlightSource(world, lidar=LIDAR, rules=RULES)
    with_limit = source.observe().remembered
    assert len(with_limit(SLOW).sweeps) == len(with_limit(FAST).sweeps) == 30  # all that there are at the start
    session = Session(source, config=SLOW)
    try:
        while (frame := session.tick()).time < 2.0:
            pass
        session.configure(SLOW.replace({"memory.memory_distance": 0.0, "memory.memory_time": 1.0}))
        slow, short = frame.observation, session.tick().observation
    finally:
        session.close()
    count = 30 + round(LIDAR.sweep_rate * frame.time)
    assert (len(slow.sweeps), slow.sweeps.thinned, len(short.sweeps), short.sweeps.thinned) == (
        count,
        count - 10,
        10,
        0,
    )
    assert list(map(id, short.sweeps))[:-1] == list(map(id, slow.sweeps))[-9:]
    assert slow.sweep_times is not None and short.sweep_times is not None
    np.testing.assert_array_equal(short.sweep_times[:-1], slow.sweep_times[-9:])


def test_drones_of_a_batch_remember_as_their_own_limits_say(world: World, device: str):
    together = FlightBatch([world, world], config=[SLOW, FAST], device=device, seed=[5, 5], lidar=LIDAR, rules=RULES)
    together.run()
    positions = together.simulator.vehicle.position.numpy()
    for config, position in zip((SLOW, FAST), positions, strict=True):
        alone = FlightBatch([world], config=config, device=device, seed=5, lidar=LIDAR, rules=RULES)
        alone.run()
        np.testing.assert_array_equal(alone.simulator.vehicle.position.numpy()[0], position)


def test_a_slow_flight_is_that_of_its_batch(world: World):
    batch = FlightBatch([world], config=SLOW, seed=5, lidar=LIDAR, rules=RULES)
    batch.run()
    source = FlightSource(world, lidar=LIDAR, rules=RULES, control_step=SLOW.sampling.dt, seed=5)
    session = Session(source, config=SLOW, seed=5)
    try:
        while source.outcome is None:
            session.tick()
    finally:
        session.close()
    np.testing.assert_array_equal(source.simulator.vehicle.position.numpy(), batch.simulator.vehicle.position.numpy())
