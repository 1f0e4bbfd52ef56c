"""A sensor that shows nothing, although it should, makes the cloud stale."""

from collections.abc import Callable

import numpy as np
import pytest
import warp as wp

from aero_planner import Goal, Planner, PlanStatus, Sweeps, VehicleState
from tests.planner.cases import config_of

ROOM = np.random.default_rng(0).uniform((2, -8, -2), (9, 8, 4), (3000, 3)).astype(np.float32)
FEW = ROOM.copy()
FEW[70:] = np.nan
BLIND = {
    "nothing": np.zeros((0, 3), np.float32),
    "rays without return": np.full((3000, 3), np.nan, np.float32),
    "infinite": np.full((3000, 3), np.inf, np.float32),
    "millimetres": 1000.0 * ROOM,
    "millimetres of integers": (1000.0 * ROOM).astype(np.int32),
}
SEEING = {"room": ROOM, "few": FEW, "one": np.concatenate((BLIND["infinite"], ROOM[:1])), "reversed": FEW[::-1]}
TICKS, PERIOD = 8, 0.1


@pytest.fixture(scope="module")
def planner(device: str) -> Planner:
    return Planner(config_of(), device=device)


def statuses(planner: Planner, cloud: Callable[[int], object], *, stamps: bool = True, **options: object) -> list[str]:
    """Return the status of the plans of some ticks."""
    planner.reset()
    found = []
    for tick in range(TICKS):
        time = tick * PERIOD if stamps else None
        state = VehicleState((0.1 * tick, 0, 1), (1, 0, 0), (1, 0, 0, 0), time=time)
        plan = planner.plan(state, Goal((20, 0, 1)), cloud(tick), **options)  # type: ignore[arg-type]
        found.append(plan.status.name)
    return found


STALE = ["OK"] * 6 + ["STALE_CLOUD"] * 2
"""The first plan is the first that is heard of the sensor; partition.cloud_age_max is 0.5 s."""


@pytest.mark.parametrize("name", BLIND)
def test_a_cloud_that_shows_nothing_becomes_stale(planner: Planner, name: str):
    points = BLIND[name]
    assert statuses(planner, lambda _: points) == STALE
    sweep = np.asarray(points, np.float32)
    assert statuses(planner, lambda _: Sweeps([ROOM[:9] + 4.0, sweep])) == STALE, "the newest sweep counts"
    assert statuses(planner, lambda _: Sweeps()) == STALE
    on_device = wp.array(sweep, dtype=wp.vec3, device=planner.device)
    assert statuses(planner, lambda _: on_device) == STALE


@pytest.mark.parametrize("distance", [0.0, 0.08])
def test_returns_of_the_drone_itself_show_nothing(planner: Planner, distance: float):
    own = distance * np.eye(3, dtype=np.float32)[np.arange(3000) % 3]

    def seen(tick: int) -> np.ndarray:
        return own + np.array([0.1 * tick, 0, 1], np.float32)

    assert statuses(planner, seen) == STALE
    assert statuses(planner, lambda tick: Sweeps([ROOM + 4.0, seen(tick)])) == STALE
    assert statuses(planner, seen, empty_is_clear=True) == ["OK"] * TICKS
    assert "STALE_CLOUD" not in statuses(planner, lambda tick: np.concatenate((seen(tick), ROOM[:100] + 4.0)))


@pytest.mark.parametrize("name", ["nothing", "rays without return", "infinite"])
def test_a_caller_may_say_that_nothing_is_in_range(planner: Planner, name: str):
    assert statuses(planner, lambda _: BLIND[name], empty_is_clear=True) == ["OK"] * TICKS


def test_millimetres_are_never_clear(planner: Planner):
    assert statuses(planner, lambda _: BLIND["millimetres"], empty_is_clear=True) == STALE


@pytest.mark.parametrize("name", SEEING)
def test_a_sensor_that_sees_something_is_not_blind(planner: Planner, name: str):
    assert "STALE_CLOUD" not in statuses(planner, lambda _: SEEING[name] + [4.0, 0.0, 0.0])
    assert "STALE_CLOUD" not in statuses(planner, lambda tick: SEEING[name] if tick % 4 == 3 else BLIND["nothing"])


def test_time_without_stamps_is_that_of_the_plans(device: str):
    planner = Planner(config_of(partition__cloud_age_max=0.1), device=device)
    found = statuses(planner, lambda _: BLIND["nothing"], stamps=False)
    assert found == ["OK" if tick <= 5 else "STALE_CLOUD" for tick in range(TICKS)]  # 0.02 s each


def test_what_was_seen_is_a_part_of_the_history(planner: Planner):
    statuses(planner, lambda _: BLIND["nothing"])
    history = planner.history()
    state = VehicleState((1, 0, 1), (1, 0, 0), (1, 0, 0, 0), time=TICKS * PERIOD)
    for _ in range(2):
        planner.restore(history)
        assert planner.plan(state, Goal((20, 0, 1)), BLIND["nothing"]).status == PlanStatus.STALE_CLOUD
        assert planner.plan(state, Goal((20, 0, 1)), ROOM + 3.0).status != PlanStatus.STALE_CLOUD


def test_each_drone_of_a_batch_has_its_own_eyes(device: str):
    planner, still, level = Planner(config_of(), device=device, batch=2), np.zeros((2, 3)), [[1.0, 0, 0, 0]] * 2
    plans = [
        planner.plan(VehicleState(still, still, level, time=[time, time]), Goal(still + 9.0), [BLIND["nothing"], ROOM])
        for time in (0.0, 0.6)
    ]
    stale = [(plan.status == PlanStatus.STALE_CLOUD).tolist() for plan in plans]
    assert stale == [[False, False], [True, False]]
