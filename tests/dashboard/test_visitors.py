"""Several visitors: one holds control, the others look on."""

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest

from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.server import LocalServer
from aero_viz.dashboard.viser_private import commands, identifier, inputs, uploads
from aero_viz.dashboard.visitors import Visitors
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for


def test_the_first_visitor_has_control_until_another_one_takes_it():
    visitors = Visitors()
    for number in (3, 5):
        visitors.join(number, may_control=True)
    assert visitors.has_control(3) and not visitors.has_control(5) and visitors.count == 2
    assert visitors.take_control(5)
    assert visitors.has_control(5) and not visitors.has_control(3)


def test_control_passes_on_when_its_holder_leaves():
    visitors = Visitors()
    for number, may_control in ((1, True), (2, False), (3, True), (4, True)):
        visitors.join(number, may_control=may_control)
    visitors.leave(1)
    assert visitors.has_control(3)
    visitors.leave(4)
    visitors.leave(3)
    assert not visitors.has_control(2)
    visitors.join(7, may_control=True)
    assert visitors.has_control(7)


def test_a_view_only_visitor_never_gets_control():
    visitors = Visitors()
    visitors.join(1, may_control=False)
    assert not visitors.has_control(1) and not visitors.take_control(1) and not visitors.has_control(1)
    assert not visitors.take_control(99)


def test_a_page_that_belongs_to_no_person_is_not_counted():
    visitors = Visitors()
    for number in (1, 2):
        visitors.join(number, may_control=True)
    visitors.exclude(2)
    visitors.join(2, may_control=True)
    assert visitors.count == 1 and not visitors.is_present(2) and not visitors.take_control(2)
    visitors.leave(2)
    visitors.join(2, may_control=True)
    assert visitors.is_present(2), "the number of another page"


@pytest.fixture
def pair(server: LocalServer) -> Iterator[tuple[Any, Any]]:
    """Two clients, the first of which has control."""
    with contextlib.ExitStack() as stack:
        clients = []
        for count in (1, 2):
            clients.append(stack.enter_context(join(server)))
            send(clients[-1], **CAMERA)
            wait_for(lambda count=count: len(server.get_clients()) == count, "the client")
        yield clients[0], clients[1]


def set_value(client: Any, control: Any, value: Any) -> None:
    send(client, type="GuiUpdateMessage", uuid=identifier(control), updates={"value": value})


def test_only_who_has_control_uses_what_all_share(server: LocalServer, pair):
    first, second = pair
    slider, end = server.gui.add_slider("Speed", 0.0, 4.0, 0.5, 1.0), server.gui.add_checkbox("end", False)
    upload = server.gui.add_upload_button("Upload")
    pressed: list[Any] = []
    server.gui.add_button("Play").on_click(pressed.append)
    server.gui.add_command("Pause").on_trigger(pressed.append)
    play = next(c for c in inputs(server.gui).values() if c.label == "Play")
    command = next(iter(commands(server.gui)))
    set_value(second, slider, 3.0)
    set_value(second, play, True)
    send(second, type="CommandTriggerMessage", uuid=command)
    send(
        second, type="FileTransferStartUpload", source_component_uuid=identifier(upload), transfer_uuid="a",
        filename="f.yaml", mime_type="", part_count=1, size_bytes=1,
    )  # fmt: skip
    heard = read_until(second, "You are watching")
    assert identifier(slider) in heard, "the page shows the value that stays"
    own = server.get_clients()[1].gui.add_checkbox("own", False)
    set_value(second, own, True)
    wait_for(lambda: own.value, "the visitor's own control, after all of the above")
    set_value(first, end, True)
    wait_for(lambda: end.value, "the first visitor")
    assert slider.value == 1.0 and not pressed and not uploads(server.gui)
    server.visitors.take_control(1)
    set_value(second, slider, 3.0)
    wait_for(lambda: slider.value == 3.0, "the second visitor")
    set_value(first, slider, 2.0)
    read_until(first, "You are watching")
    assert slider.value == 3.0


def test_nobody_uses_the_own_controls_of_another(server: LocalServer, pair):
    _, second = pair
    own = server.get_clients()[0].gui.add_checkbox("own", False)
    seen = server.get_clients()[1].gui.add_checkbox("seen", False)
    set_value(second, own, True)
    set_value(second, seen, True)
    wait_for(lambda: seen.value, "the last message")
    assert not own.value
    server.visitors.take_control(1)
    set_value(second, own, True)
    set_value(second, seen, False)
    wait_for(lambda: not seen.value, "the last message")
    assert not own.value


def test_control_passes_on_when_a_client_disconnects(server: LocalServer, pair):
    first, _ = pair
    first.close()
    wait_for(lambda: server.visitors.count == 1, "the first to leave")
    assert server.visitors.has_control(1)


def test_a_change_for_a_visitor_who_has_left_is_skipped(server: LocalServer, pair):
    with server.gui.add_folder("Shared"):
        own = server.get_clients()[0].gui.add_checkbox("own", False)
    pair[0].close()
    wait_for(lambda: server.visitors.count == 1, "the first to leave")
    with pytest.raises(RuntimeError):
        own.visible = False
    apply([(own, "visible", False)])
