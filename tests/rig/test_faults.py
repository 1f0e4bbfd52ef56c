"""Faults as text, and their effects on a channel."""

import itertools

import pytest

from aero_viz.errors import UserError
from aero_viz.rig.faults import FAULT_KINDS, Channel, Fault, parse_fault


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("drop=0.2@3+2", Fault("drop", 3.0, 2.0, 0.2)),
        ("drop@3", Fault("drop", 3.0, FAULT_KINDS["drop"].duration, FAULT_KINDS["drop"].amount)),
        ("pause-node@4.5", Fault("pause-node", 4.5, 0.5)),
        ("freeze-state@1+.75", Fault("freeze-state", 1.0, 0.75)),
    ],
)
def test_a_text_describes_a_fault(text, fault):
    assert parse_fault(text) == fault
    assert parse_fault(text).end == fault.at + fault.duration


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("drop", "write KIND"),
        ("drop@x", "write KIND"),
        ("drop@-1", "write KIND"),
        ("explode@3", "no fault 'explode'"),
        ("drop=1.5@3", "probability"),
        ("pause-node=3@1", r"pause-node has no amount; write pause-node@TIME\[\+DURATION\]\."),
        ("kill-node=7@1", "kill-node has no amount; write kill-node@TIME"),
        ("restart-node@1+9", "restart-node has no duration; write restart-node@TIME"),
        ("drop@10000000", r"The time of the fault drop is 10000000.0; it must be in \[0, 1e\+06\)"),
    ],
)
def test_a_malformed_fault_is_refused(text, error):
    with pytest.raises(UserError, match=error):
        parse_fault(text)


def packets_through(amounts, count=1000):
    """Send numbered packets, one per millisecond; return (time, data) of what arrives."""
    arrived = []
    channel = Channel(lambda data: arrived.append((now, data)), seed=1)
    channel.faults.update(amounts)
    for k in range(count):
        now = 0.001 * k
        channel.put(k.to_bytes(8, "little"), now)
    now = 10.0
    channel.flush(now)
    return arrived


def number(data):
    return int.from_bytes(data, "little")


def test_a_channel_without_faults_changes_nothing():
    assert [number(data) for _, data in packets_through({})] == list(range(1000))


def test_drop():
    assert 600 < len(packets_through({"drop": 0.3})) < 800


def test_duplicate():
    arrived = [number(data) for _, data in packets_through({"duplicate": 0.3})]
    assert 1200 < len(arrived) < 1400
    assert set(arrived) == set(range(1000))


def test_corrupt():
    arrived = packets_through({"corrupt": 0.3})
    changed = sum(data != k.to_bytes(8, "little") for k, (_, data) in enumerate(arrived))
    assert 200 < changed < 400
    assert len(arrived) == 1000


def test_delay():
    late = [time - 0.001 * number(data) for time, data in packets_through({"delay": 0.05}, 2000) if time < 10.0]
    assert min(late) >= 0.0
    assert max(late) <= 0.1015  # to the millisecond in which it is delivered
    assert sum(late) / len(late) == pytest.approx(0.05, abs=0.005)


def test_reorder():
    arrived = [number(data) for _, data in packets_through({"reorder": 0.3})]
    assert sorted(arrived) == list(range(1000))
    overtaken = [k for k, following in itertools.pairwise(arrived) if following < k]
    assert len(overtaken) > 50
    # No packet is held back by more than 20 ms.
    assert max(index - k for index, k in enumerate(arrived)) <= 21


def test_delayed_packets_arrive_after_the_fault():
    arrived = []
    channel = Channel(arrived.append)
    channel.faults["delay"] = 0.5
    channel.put(b"early", 0.0)
    channel.faults.clear()
    channel.put(b"later", 2.0)
    assert arrived == [b"early", b"later"]
