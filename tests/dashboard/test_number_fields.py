"""Numbers that a page types, with real websockets: what counts, what is refused, and what waits meanwhile."""

from typing import Any

import pytest

from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.number_fields import NumberFields, typed_value
from aero_viz.dashboard.viser_private import identifier
from aero_viz.errors import UserError
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for


def type_into(client: Any, control: Any, text: str | None, *, index: int = 0, is_over: bool = True) -> None:
    message = {"type": "AeroNumberMessage", "uuid": identifier(control), "index": index, "text": text}
    send(client, **message, is_over=is_over)


def test_a_number_counts_when_typing_is_over_and_a_click_after_it_finds_it(server, client):
    place = server.gui.add_vector3("Goal", (1.25, 2.0, 3.0))
    speed, seen, found = server.gui.add_number("Speed", 7.0), [], []
    speed.on_update(lambda event: seen.append(event.target.value))
    apply_it = server.gui.add_button("Apply")

    @apply_it.on_click
    async def _(_: Any) -> None:
        found.append((speed.value, place.value))

    type_into(client, speed, None, is_over=False)
    type_into(client, speed, "0.35")
    type_into(client, place, "-4.5", index=1)
    send(client, type="GuiUpdateMessage", uuid=identifier(apply_it), updates={"value": True})
    wait_for(lambda: found, "the click")
    assert found == [(0.35, (1.25, -4.5, 3.0))]
    wait_for(lambda: seen, "the callback")
    assert seen == [0.35]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "Seed: the field was empty, so 5 stays."),
        ("-", "Seed: '-' is not a number in digits, such as -1.5, so 5 stays."),
        ("1e", "Seed: '1e' is not a number in digits, such as -1.5, so 5 stays."),
        ("nan", "Seed: 'nan' is not a number in digits, such as -1.5, so 5 stays."),
        ("-inf", "Seed: -inf is too large, so 5 stays."),
        ("1e300", "Seed: 1e300 is too large, so 5 stays."),
        ("-3", "Seed: -3 is less than 0, so 5 stays."),
        ("12", "Seed: 12 is more than 9, so 5 stays."),
        ("1.5", "Seed: 1.5 is not a whole number, so 5 stays."),
    ],
)
def test_what_does_not_count_leaves_the_number_and_the_page_says_why(server, client, text: str, words: str):
    seed = server.gui.add_number("Seed", 5, min=0, max=9)
    type_into(client, seed, text)
    read_until(client, words)
    assert seed.value == 5
    with pytest.raises(UserError, match="so 5 stays"):
        typed_value(seed, 0, text)


def test_nothing_but_a_number_field_takes_a_number(server, client):
    box, off = server.gui.add_checkbox("box", False), server.gui.add_number("off", 1.0, disabled=True)
    for control, index in ((box, 0), (off, 0), (server.gui.add_number("on", 1.0), 1)):
        with pytest.raises(ValueError):
            typed_value(control, index, "1")
        type_into(client, control, "3", index=index)
    send(client, type="GuiUpdateMessage", uuid=identifier(box), updates={"value": True})
    wait_for(lambda: box.value, "the message after them")
    assert off.value == 1.0


def test_who_only_watches_is_reminded_when_typing(server, client):
    speed = server.gui.add_number("Speed", 7.0)
    with join(server) as watcher:
        send(watcher, **CAMERA)
        wait_for(lambda: len(server.get_clients()) == 2, "the watcher")
        type_into(watcher, speed, "8")
        assert identifier(speed) in read_until(watcher, "You are watching"), "the page shows the number that stays"
    assert speed.value == 7.0


def test_a_field_keeps_what_is_typed_until_that_is_over_or_its_visitor_has_left(server):
    time, other, told = server.gui.add_number("Time", 0.0), server.gui.add_number("Other", 0.0), []
    fields = NumberFields()
    fields.on_waiting = lambda: told.append(True)

    def show(value: float) -> tuple[float, float]:
        apply(fields.admit([(time, "value", value), (other, "value", value)]))
        return time.value, other.value

    fields.type(1, time)
    assert show(1.0) == (0.0, 1.0)
    fields.leave(2)
    assert show(2.0) == (0.0, 2.0)
    fields.leave(1)
    assert told, "the newest value is asked for"
    apply(fields.admit([]))
    assert time.value == 2.0, "typing was given up"
    fields.type(1, time)
    assert show(3.0) == (2.0, 3.0)
    fields.leave(1, with_number=True)
    apply(fields.admit([]))
    assert time.value == 2.0, "the typed number is newer"
