import threading

from aero_viz.session.publisher import Publisher


def test_unsubscribe_can_wait_for_the_items_published_so_far():
    publisher, gate, seen = Publisher(), threading.Event(), []

    def slow(item: int) -> None:
        gate.wait(60.0)
        seen.append(item)

    sink = publisher.subscribe(slow, capacity=10, name="slow")
    for i in range(3):
        publisher.publish(i)
    threading.Timer(0.2, gate.set).start()
    publisher.unsubscribe(sink, timeout=60.0)
    publisher.publish(3)
    assert (seen, sink.dropped) == ([0, 1, 2], 0)


def test_items_reach_every_sink_until_it_unsubscribes():
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
