from __future__ import annotations

import threading

from aero_planner.mailbox import Mailbox


def test_it_keeps_the_newest_items_and_never_delays_the_sender():
    gate, first, seen = threading.Event(), threading.Event(), []

    def slow(item: int) -> None:
        first.set()
        assert gate.wait(10.0)
        seen.append(item)

    mailbox: Mailbox[int] = Mailbox(slow, capacity=3, name="test")
    mailbox.put(0)
    assert first.wait(10.0)
    for i in range(1, 100):
        mailbox.put(i)  # returns at once although the callback hangs
    gate.set()
    mailbox.finish()
    assert seen == [0, 97, 98, 99] and mailbox.dropped == 96


def test_it_survives_exceptions_of_its_callback():
    seen = []

    def bad(item: int) -> None:
        seen.append(item)
        raise RuntimeError("no")

    mailbox: Mailbox[int] = Mailbox(bad, capacity=10, name="test")
    for i in range(5):
        mailbox.put(i)
    mailbox.finish()
    assert seen == [0, 1, 2, 3, 4] and mailbox.failures == 5


def test_finishing_delivers_what_waits_and_closing_drops_it():
    gate, first, ends, seen = threading.Event(), threading.Event(), [], []

    def slow(item: int) -> None:
        first.set()
        assert gate.wait(10.0)
        seen.append(item)

    mailbox: Mailbox[int] = Mailbox(slow, capacity=10, name="test", at_end=lambda: ends.append(len(seen)))
    for i in range(4):
        assert mailbox.put(i)
    assert first.wait(10.0) and not mailbox.drain(0.01)
    assert not mailbox.close(0.01) and mailbox.dropped == 3
    assert not mailbox.put(4) and mailbox.dropped == 3
    gate.set()
    assert mailbox.close(10.0) and seen == [0] and ends == [1]

    mailbox = Mailbox(slow, capacity=10, name="test", at_end=lambda: ends.append(len(seen)))
    for i in range(5, 8):
        mailbox.put(i)
    assert mailbox.finish(10.0) and seen == [0, 5, 6, 7] and ends == [1, 4] and mailbox.dropped == 0


def test_items_arrive_in_order() -> None:
    seen: list[int] = []
    mailbox = Mailbox(seen.append, capacity=100, name="test")
    for i in range(50):
        mailbox.put(i)
    assert mailbox.drain()
    assert seen == list(range(50))
    mailbox.close()


def test_a_slow_callback_gets_the_newest_item_and_delays_nobody() -> None:
    gate, first, seen = threading.Event(), threading.Event(), []

    def slow(item: int) -> None:
        first.set()
        gate.wait(5.0)
        seen.append(item)

    mailbox = Mailbox(slow, capacity=1, name="test")
    mailbox.put(0)
    assert first.wait(5.0)
    for i in range(1, 100):
        mailbox.put(i)  # returns at once though the callback hangs
    gate.set()
    assert mailbox.drain()
    assert seen == [0, 99]
    assert mailbox.dropped == 98
    mailbox.close()


def test_a_failure_is_counted_and_delivery_continues() -> None:
    seen: list[int] = []

    def fails_on_even(item: int) -> None:
        if item % 2 == 0:
            raise RuntimeError("even")
        seen.append(item)

    mailbox = Mailbox(fails_on_even, capacity=10, name="test")
    for i in range(4):
        mailbox.put(i)
    assert mailbox.drain()
    assert seen == [1, 3]
    assert mailbox.failures == 2
    mailbox.close()


def test_close_drops_waiting_items_and_waits_for_the_delivery_in_progress() -> None:
    first, gate, seen = threading.Event(), threading.Event(), []

    def slow(item: int) -> None:
        first.set()
        gate.wait(5.0)
        seen.append(item)

    mailbox = Mailbox(slow, capacity=3, name="test")
    for i in range(3):
        mailbox.put(i)
    assert first.wait(5.0) and not mailbox.drain(0.05)
    mailbox.close(timeout=0.05)
    assert (seen, mailbox.dropped) == ([], 2)
    mailbox.put(3)
    threading.Timer(0.2, gate.set).start()
    mailbox.close(timeout=None)
    assert (seen, mailbox.dropped) == ([0], 2)
