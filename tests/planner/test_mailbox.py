import threading

import pytest

from aero_planner.mailbox import Mailbox


class SlowCallback:
    """Callback that waits for `gate` before it records an item; `started` is set once it has been called."""

    def __init__(self) -> None:
        self.gate, self.started, self.seen = threading.Event(), threading.Event(), list[int]()

    def __call__(self, item: int) -> None:
        self.started.set()
        assert self.gate.wait(60.0)
        self.seen.append(item)


@pytest.fixture
def slow() -> SlowCallback:
    return SlowCallback()


@pytest.mark.parametrize(("capacity", "expected"), [(1, [0, 99]), (3, [0, 97, 98, 99])])
@pytest.mark.parametrize("end", [Mailbox.drain, Mailbox.finish])
def test_it_keeps_the_newest_items_and_never_delays_the_sender(slow: SlowCallback, capacity: int, expected, end):
    mailbox = Mailbox(slow, capacity=capacity, name="test")
    mailbox.put(0)
    assert slow.started.wait(60.0)
    for i in range(1, 100):
        mailbox.put(i)  # returns at once although the callback hangs
    slow.gate.set()
    assert end(mailbox)
    assert slow.seen == expected and mailbox.dropped == 100 - len(expected)
    mailbox.close()


@pytest.mark.parametrize("end", [Mailbox.drain, Mailbox.finish])
def test_a_failure_is_counted_and_delivery_continues(end):
    seen, succeeded = [], []

    def fails_on_even(item: int) -> None:
        seen.append(item)
        if item % 2 == 0:
            raise RuntimeError("even")
        succeeded.append(item)

    mailbox: Mailbox[int] = Mailbox(fails_on_even, capacity=10, name="test")
    for i in range(5):
        mailbox.put(i)
    assert end(mailbox)
    assert seen == [0, 1, 2, 3, 4] and succeeded == [1, 3] and mailbox.failures == 3
    mailbox.close()


def test_finishing_delivers_waiting_items_and_closing_drops_them(slow: SlowCallback):
    ends = []
    mailbox = Mailbox(slow, capacity=10, name="test", at_end=lambda: ends.append(len(slow.seen)))
    for i in range(4):
        assert mailbox.put(i)
    assert slow.started.wait(60.0) and not mailbox.drain(0.01)
    assert not mailbox.close(0.01) and mailbox.dropped == 3
    assert not mailbox.put(4) and mailbox.dropped == 3
    slow.gate.set()
    assert mailbox.close(60.0) and slow.seen == [0] and ends == [1]

    mailbox = Mailbox(slow, capacity=10, name="test", at_end=lambda: ends.append(len(slow.seen)))
    for i in range(5, 8):
        mailbox.put(i)
    assert mailbox.finish(60.0) and slow.seen == [0, 5, 6, 7] and ends == [1, 4] and mailbox.dropped == 0


def test_items_arrive_in_order():
    seen: list[int] = []
    mailbox = Mailbox(seen.append, capacity=100, name="test")
    for i in range(50):
        mailbox.put(i)
    assert mailbox.drain()
    assert seen == list(range(50))
    mailbox.close()


def test_close_without_timeout_waits_for_the_delivery_in_progress(slow: SlowCallback):
    mailbox = Mailbox(slow, capacity=3, name="test")
    for i in range(3):
        mailbox.put(i)
    assert slow.started.wait(60.0) and not mailbox.drain(0.05)
    mailbox.close(timeout=0.05)
    assert (slow.seen, mailbox.dropped) == ([], 2)
    mailbox.put(3)
    threading.Timer(0.2, slow.gate.set).start()
    mailbox.close(timeout=None)
    assert (slow.seen, mailbox.dropped) == ([0], 2)
