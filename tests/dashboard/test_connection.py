"""Messages that a client may send, with real websockets: values of controls, uploads, and garbage."""

import asyncio
import socket
import threading
import time

import numpy as np
import pytest
import viser
from websockets.exceptions import InvalidStatus

from aero_viz.dashboard import viser_private
from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.server import LocalServer
from aero_viz.dashboard.viser_private import connections, identifier
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for

LIMIT = 1000


@pytest.fixture
def server():
    """A server that takes uploads of up to 1000 bytes."""
    server = LocalServer(port=0, upload_limit=LIMIT)
    yield server
    server.stop()


def set_value(client, control, **updates) -> None:
    send(client, type="GuiUpdateMessage", uuid=identifier(control), updates=updates)


def test_no_attribute_of_a_control_but_its_value_can_be_set(server, client):
    play = server.gui.add_button("Play")
    speed = server.gui.add_slider("Speed", 0.0, 4.0, 0.5, 1.0)
    for name, value in (("removed", True), ("value", 3.0), ("uuid", "x"), ("is_button", True), ("sync_cb", None)):
        for control in (play, speed):
            set_value(client, control, **{name: value, "removed": True})
    set_value(client, speed, value=2.0)
    wait_for(lambda: speed.value == 2.0, "the last message")
    play.label = "Still here"
    read_until(client, "Still here")


def test_a_value_that_a_page_has_just_sent_is_not_overwritten_with_an_older_one(server, client):
    height = server.gui.add_number("Height", 1.0)
    computed_at = time.time()
    time.sleep(0.01)
    set_value(client, height, value=3.5)
    wait_for(lambda: height.value == 3.5, "the message")
    apply([(height, "value", 1.0), (height, "label", "Height [m]")], computed_at=computed_at)
    assert (height.value, height.label) == (3.5, "Height [m]")
    apply([(height, "value", 2.0)], computed_at=time.time())
    assert height.value == 2.0


@pytest.mark.parametrize(
    ("add", "wrong", "right"),
    [
        (lambda gui: gui.add_checkbox("c", False), (1, "yes", None), True),
        (lambda gui: gui.add_slider("s", 0.0, 1.0, 0.1, 0.5), (float("nan"), "1", True, None, []), 1),
        (lambda gui: gui.add_number("n", 1, min=0, step=1), (2.5, float("inf"), 1 << 63, "2", {}), 7),
        (lambda gui: gui.add_number("n", 1.5), (float("nan"), float("-inf"), "2", None), -3.25),
        (lambda gui: gui.add_vector3("v", (0.0, 0.0, 0.0)), ((1.0,), (1.0, 2.0, float("nan")), 3.0), [1.0, 2.0, 3.0]),
        (lambda gui: gui.add_dropdown("d", ("a", "b")), ("c", 1, None, ["a"]), "b"),
        (lambda gui: gui.add_button_group("g", ("a", "b")), ("c", 1, None), "b"),
        (lambda gui: gui.add_text("t", ""), (1, None, "x" * 100_000), "forest"),
    ],
)
def test_only_values_that_fit_a_control_are_taken(server, client, add, wrong, right):
    control = add(server.gui)
    seen = []

    @control.on_click if isinstance(control, viser.GuiButtonGroupHandle) else control.on_update
    async def _(_) -> None:
        seen.append(control.value)

    for value in (*wrong, right):
        set_value(client, control, value=value)
    expected = tuple(right) if isinstance(right, list) else right
    wait_for(lambda: control.value == expected, "the last value")
    wait_for(lambda: seen, "the callback")
    assert seen == [expected]


def test_a_number_beyond_the_bounds_ends_at_them_also_on_the_page_that_sent_it(server, client):
    slider = server.gui.add_slider("Time", 0.0, 4.0, 0.5, 1.0)
    number = server.gui.add_number("Seed", 5, min=0)
    read_until(client, identifier(number))
    set_value(client, slider, value=100.0)
    set_value(client, number, value=-3)
    wait_for(lambda: (slider.value, number.value) == (4.0, 0), "the bounds")
    read_until(client, identifier(number))


def test_a_disabled_control_cannot_be_used(server, client):
    off, on = server.gui.add_number("off", 1.0, disabled=True), server.gui.add_number("on", 1.0)
    set_value(client, off, value=2.0)
    set_value(client, on, value=2.0)
    wait_for(lambda: on.value == 2.0, "the other control")
    assert off.value == 1.0


@pytest.mark.parametrize(
    "garbage",
    [
        b"", b"\x00", b"\xff" * 100, b"\x91" * 5000, "text", b"\x81\xa4type\xa6nobody",
        b"\x81\xa4type\xb0GuiUpdateMessage", b"\x82\xa4type\xb3ViewerCameraMessage\xa4wxyz\xc0",
    ],
)  # fmt: skip
def test_garbage_is_ignored_without_a_traceback(server, client, caplog, capfd, garbage):
    box = server.gui.add_checkbox("box", False)
    client.send(garbage)
    set_value(client, box, value=True)
    wait_for(lambda: box.value, "the message after the garbage")
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def start_upload(client, button, size: int, *, parts: int = 1, name: str = "a") -> None:
    send(
        client, type="FileTransferStartUpload", source_component_uuid=identifier(button), transfer_uuid=name,
        filename="f.yaml", mime_type="", part_count=parts, size_bytes=size,
    )  # fmt: skip


def send_part(client, button, content: bytes, *, index: int = 0, name: str = "a") -> None:
    send(
        client, type="FileTransferPart", source_component_uuid=identifier(button), transfer_uuid=name,
        part_index=index, content=content,
    )  # fmt: skip


@pytest.fixture
def uploads(server: LocalServer):
    """A button for uploads, and the contents that arrived."""
    button, contents = server.gui.add_upload_button("Upload"), []

    @button.on_upload
    async def _(_) -> None:
        contents.append(button.value.content)

    return button, contents


def test_a_file_up_to_the_limit_arrives(client, uploads):
    button, contents = uploads
    start_upload(client, button, LIMIT, parts=2)
    send_part(client, button, b"b" * 400, index=1)
    send_part(client, button, b"a" * 600, index=0)
    wait_for(lambda: contents, "the upload")
    assert contents == [b"a" * 600 + b"b" * 400]
    start_upload(client, button, 1, name="b")
    send_part(client, button, b"c", name="b")
    wait_for(lambda: len(contents) == 2, "the next upload")


def test_a_file_above_the_limit_is_refused_before_its_first_part(server, client, uploads, caplog):
    button, contents = uploads
    start_upload(client, button, 5 * LIMIT, parts=2)
    reason = "the page takes files of up to 1 kB. A recording is played with: aero-viz play FILE"
    heard = read_until(client, f"f.yaml has 5 kB and is not uploaded: {reason}")
    assert "RemoveNotificationMessage" in heard and "upload-a" in heard, "the page would call the upload successful"
    assert not unfinished(server)
    send_part(client, button, b"a" * LIMIT)
    start_upload(client, button, 1, name="b")
    send_part(client, button, b"b", name="b")
    wait_for(lambda: contents, "the small file")
    assert contents == [b"b"]
    assert "no page sends it" not in caplog.text


def test_a_client_cannot_send_more_than_it_announced(server, client, uploads):
    button, _ = uploads
    start_upload(client, button, 10, parts=3)
    for index in range(3):
        send_part(client, button, b"x" * 5, index=index)
        send_part(client, button, b"x" * 5, index=0)
        start_upload(client, button, LIMIT, name=f"another {index}")
    box = server.gui.add_checkbox("box", False)
    set_value(client, box, value=True)
    wait_for(lambda: box.value, "the last message")
    assert [state["transferred_bytes"] for state in unfinished(server)] == [5]


def test_unfinished_uploads_go_with_their_client(server, uploads):
    with join(server) as client:
        send(client, **CAMERA)
        start_upload(client, uploads[0], LIMIT, parts=2)
        send_part(client, uploads[0], b"x" * 500)
        wait_for(lambda: unfinished(server), "the upload")
    wait_for(lambda: not unfinished(server), "the upload to be dropped")


def unfinished(server: LocalServer) -> list:
    return list(viser_private.uploads(server.gui).values())


def test_a_message_that_is_sent_just_before_the_server_waits_is_not_forgotten(server, client, monkeypatch):
    """The moment between the check of an event and the wait for it is made long enough for another thread."""
    button = server.gui.add_button("Play")
    read_until(client, "Play")
    original, labels = asyncio.Event._get_loop, [f"label {i}" for i in range(6)]  # type: ignore[attr-defined]  # noqa: SLF001
    left = list(labels)

    def get_loop(event: asyncio.Event) -> asyncio.AbstractEventLoop:
        if left and asyncio.get_running_loop() is server.get_event_loop():
            sender = threading.Thread(target=setattr, args=(button, "label", left.pop(0)))
            sender.start()
            sender.join()
        return original(event)

    monkeypatch.setattr(asyncio.Event, "_get_loop", get_loop)
    button.label = "first"
    read_until(client, labels[-1])


def test_no_more_pages_are_open_at_once_than_there_is_room_for(server, client, monkeypatch):
    monkeypatch.setattr(server.guests, "clients_max", 2)
    with join(server):
        wait_for(lambda: len(connections(server)) == 2, "the second page")
        with pytest.raises(InvalidStatus, match="503"):
            join(server)
    wait_for(lambda: len(connections(server)) == 1, "room")
    with join(server) as third:
        read_until(third, "AERO-Viz")


@pytest.mark.skipif(not hasattr(socket, "TCP_NOTSENT_LOWAT"), reason="the system cannot limit what its kernel keeps")
def test_a_client_behind_a_slow_network_misses_old_values_and_gets_the_newest(server):
    text, points, colors = server.gui.add_markdown(""), np.zeros((8000, 3), np.float32), np.zeros(3, np.uint8)
    with socket.socket() as network:
        network.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
        network.connect((server.get_host(), server.get_port()))
        with join(server, sock=network, max_queue=1) as client:
            for number in range(40):  # 4 MB, which the kernel would take
                with server.atomic():
                    server.scene.add_point_cloud("/cloud", points, colors)
                    text.content = f"update {number}."
                time.sleep(0.02)
            heard = read_until(client, "update 39.")
    assert heard.count("update ") < 15
