from __future__ import annotations

import threading

from aero_viz.session.sinks import Publisher, Sink


def test_every_item_arrives_in_order() -> None:
    seen: list[int] = []
    sink = Sink(seen.append, capacity=100)
    for i in range(50):
        sink.put(i)
    assert sink.drain()
    assert seen == list(range(50))
    sink.close()


def test_a_slow_sink_sees_the_newest_and_delays_nobody() -> None:
    gate, first, seen = threading.Event(), threading.Event(), []

    def slow(item: int) -> None:
        first.set()
        gate.wait(5.0)
        seen.append(item)

    sink = Sink(slow, capacity=1)
    sink.put(0)
    assert first.wait(5.0)
    for i in range(1, 100):
        sink.put(i)  # returns at once though the callback hangs
    gate.set()
    assert sink.drain()
    assert seen == [0, 99]
    assert sink.dropped == 98
    sink.close()


def test_a_failing_callback_is_counted_and_goes_on() -> None:
    seen: list[int] = []

    def fails_on_even(item: int) -> None:
        if item % 2 == 0:
            raise RuntimeError("even")
        seen.append(item)

    sink = Sink(fails_on_even, capacity=10)
    for i in range(4):
        sink.put(i)
    assert sink.drain()
    assert seen == [1, 3]
    assert sink.failures == 2
    sink.close()


def test_what_waits_at_the_end_counts_as_dropped_and_the_last_delivery_is_waited_for() -> None:
    first, gate, seen = threading.Event(), threading.Event(), []

    def slow(item: int) -> None:
        first.set()
        gate.wait(5.0)
        seen.append(item)

    sink = Sink(slow, capacity=3)
    for i in range(3):
        sink.put(i)
    assert first.wait(5.0) and not sink.drain(0.05)
    sink.close(timeout=0.05)
    assert (seen, sink.dropped) == ([], 2)
    sink.put(3)
    threading.Timer(0.2, gate.set).start()
    sink.close(timeout=None)
    assert (seen, sink.dropped) == ([0], 2)


def test_who_unsubscribes_can_wait_for_what_was_published_and_no_longer() -> None:
    publisher, gate, seen = Publisher(), threading.Event(), []

    def slow(item: int) -> None:
        gate.wait(5.0)
        seen.append(item)

    sink = publisher.subscribe(slow, capacity=10, name="slow")
    for i in range(3):
        publisher.publish(i)
    threading.Timer(0.2, gate.set).start()
    publisher.unsubscribe(sink, timeout=5.0)
    publisher.publish(3)
    assert (seen, sink.dropped) == ([0, 1, 2], 0)


def test_publisher_reaches_all_until_they_unsubscribe() -> None:
    publisher, a, b = Publisher(), [], []
    sink_a = publisher.subscribe(a.append, capacity=10, name="a")
    sink_b = publisher.subscribe(b.append, capacity=10, name="b")
    publisher.publish(1)
    assert sink_a.drain() and sink_b.drain()
    publisher.unsubscribe(sink_a)
    publisher.publish(2)
    assert sink_b.drain()
    assert (a, b) == ([1], [1, 2])
    publisher.close()
