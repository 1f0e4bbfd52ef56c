"""A page whose session flies, and what must hold whatever its visitors send."""

import contextlib
import io
import logging
import re
import tempfile
from pathlib import Path

from fuzz.messages import IDENTIFIERS
from fuzz.mutation import unpack
from small_source import small_config, small_source

from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.viser_private import commands, identifier, inputs
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, send, wait_for

_STAND_IN = re.compile(rb"0{33}\d{3}")


def send_messages(path: Path) -> None:
    """Send the messages in a file to a page: those of control.messages by the visitor who holds control.

    There must be no traceback and no frame that cannot be shown, the page must answer the last message, and a visitor
    without control must change nothing.
    """
    has_control, log, errors = path.name.startswith("control"), io.StringIO(), io.StringIO()
    handler = logging.StreamHandler(log)
    logging.getLogger().addHandler(handler)
    try:
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(errors):
            _send(unpack(path), has_control, folder)
    finally:
        logging.getLogger().removeHandler(handler)
    text = log.getvalue() + errors.getvalue()
    assert "Traceback" not in text, text[-3000:]


def _send(messages: list[bytes], has_control: bool, folder: str) -> None:
    session = Session(small_source(goal=1000.0), config=small_config())
    dashboard = Dashboard(session, port=0, folders=[folder])
    try:
        server, gui = dashboard.server, dashboard.server.gui
        # Applying structural parameters would build planners of any size.
        controls = [c for c in inputs(gui).values() if getattr(c, "label", "") != "Apply"]
        names = [*(identifier(c) for c in controls), *commands(gui)]
        known = {key.encode(): names[i % len(names)].encode() for i, key in enumerate(IDENTIFIERS)}
        session.start()
        with join(server) as first, join(server) as second:
            for count, client in enumerate((first, second), start=1):
                send(client, **CAMERA)
                wait_for(lambda count=count: len(server.get_clients()) == count, "a client", timeout=60.0)
            client = first if has_control else second
            for message in messages:
                client.send(_STAND_IN.sub(lambda found: known.get(found[0], found[0]), message))
            clients = server.get_clients()
            number = next(number for number in clients if server.visitors.has_control(number) is has_control)
            end = clients[number].gui.add_checkbox("end", False)
            send(client, type="GuiUpdateMessage", uuid=identifier(end), updates={"value": True})
            wait_for(lambda: end.value, "the message after all others", timeout=60.0)
            frame = session.frame
            assert session.step(1).exception(timeout=60.0) is None and session.frame is not frame
            if not has_control:
                assert session.config == small_config(), "a visitor without control has changed a parameter"
        assert dashboard.failures == 0
    finally:
        dashboard.close()
        session.close()
