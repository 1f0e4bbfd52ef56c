"""Commands from one thread while another ticks, and while a session is started or closed."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError

import numpy as np
import pytest
from small_source import small_config, small_source

from aero_viz.flight import FlightSource
from aero_viz.planners import Plan
from aero_viz.session import Session
from aero_viz.session.frame import Frame

GOAL = [0.0, 12.0, 2.0]


class Gated(FlightSource):
    """Flight that waits in the middle of a tick until it may go on."""

    def __init__(self, *args, **options) -> None:
        super().__init__(*args, **options)
        self.inside, self.go_on, self.closed = threading.Event(), threading.Event(), threading.Event()

    def advance(self, plan: Plan) -> None:
        self.inside.set()
        assert self.go_on.wait(60.0)
        super().advance(plan)

    def close(self) -> None:
        self.closed.set()
        super().close()


@pytest.fixture
def source() -> Gated:
    source = small_source(kind=Gated)
    assert isinstance(source, Gated)
    return source


@pytest.fixture
def session(source: Gated) -> Iterator[Session]:
    session = Session(source, config=small_config(), seed=3)
    yield session
    source.go_on.set()
    session.close()


def goal_of(frame: Frame | None) -> list[float]:
    assert frame is not None
    return np.asarray(frame.observation.goal.position).tolist()


def test_a_command_from_another_thread_waits_for_the_end_of_the_tick(session: Session, source: Gated):
    first = session.tick()
    ticked: list[Frame] = []
    ticker = threading.Thread(target=lambda: ticked.append(session.tick()))
    ticker.start()
    assert source.inside.wait(60.0)
    moved = session.set_goal(GOAL)
    assert not moved.done() and session.frame is first
    source.go_on.set()
    moved.result(timeout=60.0)
    ticker.join()
    assert [frame.index for frame in ticked] == [1]
    assert goal_of(ticked[0]) == goal_of(first)
    assert session.frame is not None and session.frame.index == 1 and goal_of(session.frame) == GOAL


def test_a_tick_runs_after_the_commands_given_before_it(session: Session, source: Gated):
    session.tick()
    stepper = threading.Thread(target=session.step)
    stepper.start()
    assert source.inside.wait(60.0)
    session.set_goal(GOAL)
    threading.Timer(0.2, source.go_on.set).start()
    assert goal_of(session.tick()) == GOAL
    stepper.join()


def test_commands_from_a_page_do_not_disturb_a_loop_of_ticks():
    """Each command sets a value that is already set, so that none may change the flight."""
    trails = []
    for disturbed in (False, True):
        session, stop = Session(small_source(), config=small_config(), seed=3), threading.Event()
        session.tick()

        def page(session: Session = session, stop: threading.Event = stop) -> None:
            while not stop.wait(0.001):
                session.set_samples(False).result(timeout=60.0)

        pages = [threading.Thread(target=page) for _ in range(2 * disturbed)]
        for thread in pages:
            thread.start()
        frames = [session.tick() for _ in range(60)]
        stop.set()
        for thread in pages:
            thread.join()
        session.close()
        assert [frame.index for frame in frames] == list(range(1, 61))
        trails.append(frames[-1].trail)
    np.testing.assert_array_equal(*trails)


def test_a_started_session_refuses_to_be_ticked_or_started_again(session: Session):
    session.start(play=False)
    with pytest.raises(RuntimeError, match=r"ticks by itself; use step\(\)"):
        session.tick()
    with pytest.raises(RuntimeError, match="already started"):
        session.start()


@pytest.mark.parametrize("started", [False, True])
def test_a_closed_session_cancels_commands_and_closes_the_source_it_is_given(session: Session, started: bool):
    if started:
        session.start(play=False)
        session.pause()
    session.close()
    late = small_source(kind=Gated)
    assert isinstance(late, Gated)
    assert session.set_source(late).cancelled() and late.closed.is_set()
    assert session.set_goal(GOAL).cancelled() and session.step().cancelled()
    for use in (session.tick, session.start):
        with pytest.raises(RuntimeError, match="the session is closed"):
            use()


def test_a_session_is_closed_between_two_ticks(session: Session, source: Gated):
    session.tick()
    ticker = threading.Thread(target=session.tick)
    ticker.start()
    assert source.inside.wait(60.0)
    closer = threading.Thread(target=session.close)
    closer.start()
    closer.join(0.2)
    assert not source.closed.is_set()
    source.go_on.set()
    ticker.join()
    closer.join()
    assert source.closed.is_set()


def test_commands_given_while_a_started_session_closes_are_cancelled(session: Session, source: Gated):
    session.start(play=False)
    session.step()
    assert source.inside.wait(60.0)  # the session's thread is busy
    queued = session.step()
    closer = threading.Thread(target=session.close)
    closer.start()
    deadline = time.monotonic() + 60.0
    while not session.step().cancelled():  # until `close` has begun
        assert time.monotonic() < deadline
    late = session.step()
    assert not source.closed.is_set() and closer.is_alive()
    source.go_on.set()
    for command in (queued, late):
        with pytest.raises(CancelledError):
            command.result(timeout=60.0)
    closer.join()
    assert source.closed.is_set()
