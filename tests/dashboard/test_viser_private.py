"""The private parts of viser that the page uses: they are in one module, and those of the version that was checked."""

import ast
import asyncio
import inspect
import re
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
import viser
from viser import _messages
from viser.infra import _async_message_buffer, _infra

from aero_viz.dashboard import page_messages, viser_private
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for

ROOT = Path(__file__).parents[2]
ADAPTER, THIS = Path(viser_private.__file__), Path(__file__)
FOLDERS = ("aero_viz", "benchmarks", "examples", "tests")
CHECKED = "1.1.1"
"""Version of viser whose sources were compared with everything below."""
ADVICE = (
    "Compare every part that tests/dashboard/test_viser_private.py names with the sources of this viser, mend "
    "aero_viz/dashboard/viser_private.py and page_messages.py, and set CHECKED to its version."
)
SIGNATURES = {
    _messages.RunJavascriptMessage: "(source: 'str') -> None",
    _messages.GuiUpdateMessage: "(uuid: 'str', updates: 'Dict[str, Any]') -> None",
    _messages.RemoveNotificationMessage: "(uuid: 'str') -> None",
    _messages.FileTransferPartAck: "(source_component_uuid: 'Optional[str]', transfer_uuid: 'str', "
    "transferred_bytes: 'int', total_bytes: 'int') -> None",
    _infra.WebsockServer.queue_message: "(self, message: 'Message') -> 'None'",
    _infra.WebsockServer.on_client_connect: "(self, cb: 'Callable[[WebsockClientConnection], None | Coroutine]') "
    "-> 'None'",
    _infra.WebsockServer.on_client_disconnect: "(self, cb: 'Callable[[WebsockClientConnection], None | Coroutine]') "
    "-> 'None'",
    _infra.WebsockServer.get_message_buffer: "(self) -> 'AsyncMessageBuffer'",
    _infra.WebsockClientConnection.get_message_buffer: "(self) -> 'AsyncMessageBuffer'",
}
PARTS = {
    "_gui_input_handle_from_uuid", "_container_handle_from_uuid", "_command_handle_from_uuid",
    "_current_file_upload_states", "_impl", "_live_connections", "_connected_clients", "_websock_server",
    "_websock_connection",
}  # fmt: skip
"""Private attributes that the adapter uses."""


def is_own(node: ast.Attribute) -> bool:
    return not re.match("_[a-z]", node.attr) or ast.unparse(node.value) == "self"


def test_viser_is_the_version_that_was_checked():
    pinned = re.search(r"^viser==(\S+)", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert pinned is not None and pinned[1] == CHECKED, ADVICE
    assert viser.__version__ == CHECKED, ADVICE


def test_every_part_that_the_adapter_uses_is_named_here():
    nodes = ast.walk(ast.parse(ADAPTER.read_text()))
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute) and not is_own(node)}
    assert used - {"_get_running_loop"} == PARTS, "name it here, and check its type and meaning below"
    sent = set(re.findall(r"_messages\.(\w+)", ADAPTER.read_text()))
    assert sent == {part.__name__ for part in SIGNATURES if inspect.isclass(part)}


def test_the_parts_have_the_expected_types(server):
    button, form = server.gui.add_upload_button("Upload"), server.gui.add_folder("Folder")
    command, node = server.gui.add_command("Pause"), server.scene.add_frame("/frame")
    with join(server) as page:
        send(page, **CAMERA)
        wait_for(server.get_clients, "the client")
        (number,) = viser_private.connections(server)
        client = viser_private.client_handle(server, number)
        assert client is not None and client is server.get_clients()[number], ADVICE
        for scope in (server.gui, client.gui):
            assert isinstance(viser_private.containers(scope), dict), ADVICE
            assert isinstance(viser_private.uploads(scope), dict), ADVICE
        assert viser_private.inputs(server.gui)[viser_private.identifier(button)] is button, ADVICE
        assert form in viser_private.containers(server.gui).values(), ADVICE
        assert command in viser_private.commands(server.gui).values(), ADVICE
        for sender, kind in ((server._websock_server, "server"), (client._websock_connection, "client")):
            buffer = sender.get_message_buffer()
            assert isinstance(buffer, _async_message_buffer.AsyncMessageBuffer), ADVICE
            assert isinstance(buffer.message_event, viser_private.LoopEvent), f"{kind}: {ADVICE}"
    for handle in (button, node):
        assert not viser_private.is_removed(handle), ADVICE
        handle.remove()
        assert viser_private.is_removed(handle), ADVICE


def test_messages_wake_the_event_loop_once_they_may_be_sent(server, client):
    loop = server.get_event_loop()
    event = viser_private.LoopEvent(loop)
    event.set()
    asyncio.run_coroutine_threadsafe(asyncio.sleep(0), loop).result()
    assert not event.is_set(), "set by the thread that sends a message of an update"
    loop.call_soon_threadsafe(event.set)
    wait_for(event.is_set, "the event")
    for visitor in (server, *server.get_clients().values()):
        with visitor.atomic():
            visitor.gui.add_html("one of an update")
            visitor.gui.add_html("another one")
        read_until(client, "another one")
        visitor.gui.add_html("one alone")
        read_until(client, "one alone")


@pytest.mark.parametrize("part", SIGNATURES, ids=lambda part: part.__qualname__)
def test_messages_and_methods_have_the_expected_signature(part: Any):
    assert str(inspect.signature(part)) == SIGNATURES[part], ADVICE


OF_VISER = [kind for kind in get_args(page_messages.MESSAGES) if not str(kind.__struct_config__.tag).startswith("Aero")]


@pytest.mark.parametrize("message", OF_VISER, ids=lambda message: message.__name__)
def test_the_messages_of_a_page_have_the_fields_of_viser(message: type[msgspec.Struct]):
    tag = message.__struct_config__.tag
    expected = set(inspect.signature(getattr(_messages, str(tag))).parameters)
    assert set(message.__struct_fields__) == expected, ADVICE


def test_viser_starts_its_server_where_the_adapter_takes_part():
    source = inspect.getsource(_infra)
    assert re.search(r"websockets\.asyncio\.server\.serve\(\s*ws_handler,", source), ADVICE
    assert re.search(r"process_request=", source) and _infra.__name__.startswith("viser."), ADVICE


def test_the_page_of_viser_shows_its_charts_and_sends_where_the_scripts_expect_it():
    page = (Path(viser.__file__).parent / "client" / "src").rglob("*.ts*")
    source = "".join(path.read_text() for path in page)
    assert "__viserTestpoints" in viser_private.CHARTS and "reg[uuid] = { chart, createCount" in source, ADVICE
    assert re.search(r"\.postMessage\(\s*\{\s*type: \"send\", message", source), ADVICE


def test_nothing_else_touches_private_parts():
    modules = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") if path not in (ADAPTER, THIS)]
    found = [f"{path.relative_to(ROOT)}:{use}" for path in modules for use in private_uses(path.read_text())]
    assert found == [], f"add a function to {ADAPTER.relative_to(ROOT)} instead"


def test_uses_of_private_parts_are_found():
    found = private_uses(
        "import viser._viser\nfrom viser import _messages\nfrom viser.infra._infra import WebsockServer\n"
        "class A(viser.ViserServer):\n    def f(self): self._websock_server\n"
        "class B:\n    def f(self, page, button): self._impl, page._connected_clients, button._impl\n"
    )
    lines = [int(use.split(":")[0]) for use in found]
    assert lines == [1, 2, 3, 5, 7, 7]


def private_uses(source: str) -> list[str]:
    """Return line and name of every private part of viser in a module; a class may have its own of that name."""
    if "viser" not in source:
        return []
    tree = ast.parse(source)
    kinds = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    classes = [kind for kind in kinds if "viser." not in " ".join(map(ast.unparse, kind.bases))]
    attributes = (node for kind in classes for node in ast.walk(kind) if isinstance(node, ast.Attribute))
    own = {id(node) for node in attributes if ast.unparse(node.value) == "self"}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, name.name) for name in node.names if name.name.startswith("viser.")]
        elif isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith("viser."):
            found += [(node.lineno, f"{node.module}.{name.name}") for name in node.names]
        elif isinstance(node, ast.Attribute) and node.attr in PARTS and id(node) not in own:
            found.append((node.lineno, f".{node.attr}"))
    return [f"{line}: {name}" for line, name in sorted(found) if "._" in name]
