import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.evaluation.score import load_trajectory
from aero_viz.flight import FlightInterrupted, fly
from aero_viz.flight.interrupt import deferred_interrupt
from aero_viz.logs import flight_recorder
from aero_viz.recordings import inspect
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel

OPTIONS = {
    "config": PlannerConfig().replace({"sampling.samples": 8}),
    "lidar": LidarModel("small", points_per_sweep=500),
    "seed": 4,
}


def press_at(time: float):
    """Return a progress callback that presses Ctrl-C at a simulated time [s]."""

    def progress(share: float, simulated: float) -> None:
        if simulated >= time - 1e-9:
            signal.raise_signal(signal.SIGINT)

    return progress


def test_the_first_ctrl_c_waits_and_the_second_does_not():
    before = signal.getsignal(signal.SIGINT)
    with deferred_interrupt() as pressed:
        assert not pressed()
        signal.raise_signal(signal.SIGINT)
        assert pressed()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_second_ctrl_c_while_an_object_is_finalized_is_not_lost():
    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt), deferred_interrupt() as pressed:
        signal.raise_signal(signal.SIGINT)
        assert pressed()
        Finalized()
        time.sleep(20.0)


@pytest.fixture
def default_handler() -> Iterator[None]:
    """Python's own handler of Ctrl-C, which a background job of a shell does not have."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_ctrl_c_that_was_not_reported_takes_effect_at_the_end(default_handler):
    with pytest.raises(KeyboardInterrupt), deferred_interrupt() as pressed:
        assert not pressed()
        signal.raise_signal(signal.SIGINT)


def test_other_threads_are_never_interrupted():
    answers = []

    def ask() -> None:
        with deferred_interrupt() as pressed:
            answers.append(pressed())

    thread = threading.Thread(target=ask)
    thread.start()
    thread.join()
    assert answers == [False]


def test_exception_and_file_hold_the_flight_so_far(tmp_path):
    world = scene("wall", seed=1)
    with pytest.raises(FlightInterrupted) as caught:
        fly(world, trajectory=tmp_path / "a.csv", progress=press_at(0.3), **OPTIONS)
    result = caught.value.result
    assert (result.reason, result.arrived) == (None, False) and result.flight_time_s == pytest.approx(0.3)
    assert result.explanation is not None and result.explanation.startswith("The flight was not over after 0.30 s")
    trajectory = load_trajectory(tmp_path / "a.csv")
    assert trajectory.times[-1] == pytest.approx(0.3) and len(trajectory.times) == 16
    assert np.linalg.norm(np.diff(trajectory.positions, axis=0), axis=1).sum() == pytest.approx(
        result.length_m, abs=1e-4
    )


def test_ctrl_c_in_the_last_tick_is_not_lost():
    world = World("near", np.zeros(3), np.array([2.5, 0.0, 0.0]))
    whole = fly(world, **OPTIONS)
    with pytest.raises(FlightInterrupted) as caught:
        fly(world, progress=press_at(whole.flight_time_s), **OPTIONS)
    assert caught.value.result.arrived and caught.value.result.flight_time_s == whole.flight_time_s


def test_an_interrupted_log_is_complete(tmp_path):
    with pytest.raises(FlightInterrupted) as caught:
        fly(scene("wall", seed=1), recorder=flight_recorder(tmp_path / "a.mcap"), progress=press_at(0.3), **OPTIONS)
    assert caught.value.result.flight_time_s == pytest.approx(0.3)
    info = inspect(tmp_path / "a.mcap")
    assert info.problems == () and info.poses == 16


def test_progress_goes_from_start_to_goal(tmp_path):
    world = scene("wall", seed=1)
    for recorder in (None, flight_recorder(tmp_path / "a.mcap")):
        calls: list[tuple[float, float]] = []

        def note(share: float, time: float, calls: list[tuple[float, float]] = calls) -> None:
            calls.append((share, time))

        result = fly(world, progress=note, recorder=recorder, speed=4.0, **OPTIONS)
        shares, times = np.array(calls).T
        assert result.arrived and shares[0] == 0.0 and shares[-1] > 0.7
        assert np.all(np.diff(times) > 0.0) and times[-1] == pytest.approx(result.flight_time_s)
