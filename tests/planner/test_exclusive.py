"""One thread at a time uses a planner, and none once it is closed."""

import threading
from collections.abc import Callable
from typing import Any

import pytest

from aero_planner import Planner
from aero_viz.flight import FlightBatch
from tests.planner.cases import config_of, random_case

CASE = random_case(0)
CALLS: dict[str, Callable[[Planner], Any]] = {
    "plan": lambda planner: CASE.plan(planner),
    "configure": lambda planner: planner.configure(planner.config),
    "history": Planner.history,
    "restore": lambda planner: planner.restore(planner.history()),
    "reset": Planner.reset,
    "launch": Planner.launch,
    "reserve": lambda planner: planner.reserve(9),
    "cost_terms": Planner.cost_terms,
    "safety": Planner.safety,
    "time_stages": lambda planner: planner.time_stages(1),
}


class Held:
    """A state that keeps the thread that plans from it until `release`."""

    def __init__(self) -> None:
        self.is_reached, self._go_on = threading.Event(), threading.Event()

    def __array__(self, *_: object, **__: object) -> Any:
        self.is_reached.set()
        self._go_on.wait(60.0)
        return CASE.position.copy()

    def release(self) -> None:
        self._go_on.set()


@pytest.fixture(scope="module")
def planner(device: str) -> Planner:
    planner = Planner(config_of(), device=device)
    CASE.plan(planner)
    return planner


def test_another_thread_gets_an_error_while_one_plans(planner: Planner):
    held, plans = Held(), []
    slow = random_case(0)
    slow.position = held  # type: ignore[assignment]
    thread = threading.Thread(target=lambda: plans.append(slow.plan(planner)))
    thread.start()
    assert held.is_reached.wait(60.0)
    try:
        for name, call in CALLS.items():
            with pytest.raises(RuntimeError, match="another thread is using this planner; give each thread its own"):
                call(planner)
                pytest.fail(name)
    finally:
        held.release()
        thread.join()
    assert len(plans) == 1
    for call in CALLS.values():
        call(planner)


def test_a_closed_planner_says_so(device: str):
    planner = Planner(config_of(), device=device)
    planner.close()
    planner.close()
    for name, call in CALLS.items():
        with pytest.raises(RuntimeError, match="this planner is closed; create another one"):
            call(planner)
            pytest.fail(name)


def test_a_planner_is_closed_after_the_plan_of_another_thread(device: str):
    planner, held, plans = Planner(config_of(), device=device), Held(), []
    slow = random_case(0)
    slow.position = held  # type: ignore[assignment]
    thread = threading.Thread(target=lambda: plans.append(slow.plan(planner)))
    thread.start()
    assert held.is_reached.wait(60.0)
    closing = threading.Thread(target=planner.close)
    closing.start()
    closing.join(0.2)
    held.release()
    thread.join()
    closing.join()
    assert len(plans) == 1
    with pytest.raises(RuntimeError, match="this planner is closed"):
        CASE.plan(planner)


def test_two_threads_cannot_fly_one_batch(device: str, short_flight: FlightBatch):
    errors: list[str] = []

    def step() -> None:
        with pytest.raises(RuntimeError, match="another thread is using this batch of flights") as caught:
            short_flight.step()
        errors.append(str(caught.value))

    def meanwhile(*_: object) -> None:
        thread = threading.Thread(target=step)
        thread.start()
        thread.join()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        short_flight.run(progress=meanwhile)
    assert len(errors) == 1


@pytest.fixture
def short_flight(device: str) -> FlightBatch:
    from aero_viz.scenes import World

    world = World.from_dict({"name": "w", "start": [0, 0, 2], "goal": [3, 0, 2], "boxes": [[0, 0, -0.5, 9, 9, 1, 0]]})
    return FlightBatch([world], config=config_of(), device=device)
