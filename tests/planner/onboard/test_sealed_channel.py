"""Messages between two ends that hold a key."""

import contextlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aero_planner.onboard.sealed_channel import SealedChannel, new_nonce

KEY = bytes(range(32))


def pair(key: bytes = KEY) -> tuple[SealedChannel, SealedChannel]:
    """Return the node's end and the viewer's end of a connection; the viewer has `key`."""
    nonces = new_nonce(), new_nonce()
    return SealedChannel(KEY, *nonces, is_node=True), SealedChannel(key, *nonces, is_node=False)


def test_both_ends_read_what_the_other_one_has_sealed():
    node, viewer = pair()
    for content in ({}, {"a": 1.5, "b": ["x", None]}, {"ä": "\ud800"}):
        assert node.open(viewer.seal(content)) == content
        assert viewer.open(node.seal(content)) == content


def test_another_key_or_connection_or_direction_is_refused():
    node, viewer = pair()
    for stranger in (pair(bytes(32))[1], pair()[1], node):
        with pytest.raises(ValueError, match="sealed with another key, or altered"):
            node.open(stranger.seal({}))
    assert node.open(viewer.seal({"x": 1})) == {"x": 1}, "what was refused has moved nothing on"


def test_replays_and_reordered_messages_are_refused():
    node, viewer = pair()
    first, second, third = (viewer.seal({"n": n}) for n in range(3))
    assert node.open(second) == {"n": 1}
    for old in (first, second):
        with pytest.raises(ValueError, match="it is an old one"):
            node.open(old)
    assert node.open(third) == {"n": 2} and node.received == 3


@pytest.mark.parametrize(
    "change",
    [{"counter": 2}, {"counter": True}, {"counter": 1.0}, {"counter": 10**4000}, {"text": "{}"}, {"text": None},
     {"text": "\ud800"}, {"tag": ""}, {"tag": "é\ud800"}, {"tag": 0}, {"tag": None}],
)  # fmt: skip
def test_altered_messages_are_refused(change: dict[str, Any]):
    node, viewer = pair()
    message = viewer.seal({"x": 1})
    with contextlib.suppress(KeyError), pytest.raises(ValueError, match=r"not sealed|altered|digits"):
        node.open(message | change)
    for name in message:
        with pytest.raises(ValueError, match="not sealed"):
            node.open({key: value for key, value in message.items() if key != name})
    assert node.open(message) == {"x": 1}


@pytest.mark.parametrize("nonce", [None, "", "0" * 31, "0" * 33, "G" * 32, 5, "0" * 32 + "\n"])
def test_malformed_nonces_are_refused(nonce: Any):
    for nonces in ((nonce, new_nonce()), (new_nonce(), nonce)):
        with pytest.raises(ValueError, match="nonce is malformed"):
            SealedChannel(KEY, *nonces, is_node=True)


@given(st.dictionaries(st.sampled_from(["counter", "text", "tag", "x"]), st.none() | st.integers() | st.text()))
def test_arbitrary_messages_raise_only_value_error(message: dict[str, Any]):
    with pytest.raises(ValueError, match=r"not sealed|altered"):
        pair()[0].open(message)
