"""Random messages to the websocket of a page whose session flies."""

from __future__ import annotations

import logging
import os

import numpy as np
import pytest
from fuzz.messages import message
from small_source import small_config, small_source

from aero_viz.dashboard import Dashboard
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, send, wait_for

CASES = int(os.environ.get("AERO_VIZ_FUZZ_MESSAGES", "400"))
"""Messages for each kind of visitor."""


@pytest.mark.parametrize("has_control", [True, False])
def test_random_messages_neither_stop_the_session_nor_cause_a_traceback(has_control, caplog, capfd, tmp_path):
    caplog.set_level(logging.WARNING)
    session = Session(small_source(goal=1000.0), config=small_config())
    dashboard = Dashboard(session, port=0, folders=[tmp_path])
    server, gui = dashboard.server, dashboard.server.gui
    # Applying structural parameters would build planners of any size.
    controls = [c for c in gui._gui_input_handle_from_uuid.values() if getattr(c, "label", "") != "Apply"]
    identifiers = [*(c._impl.uuid for c in controls), *gui._command_handle_from_uuid, "/goal_arrows", "/drone", ""]
    session.start()
    with join(server) as first, join(server) as second:
        for count, client in enumerate((first, second), start=1):
            send(client, **CAMERA)
            wait_for(lambda count=count: len(server.get_clients()) == count, "a client")
        client, random = (first if has_control else second), np.random.default_rng(has_control)
        for _ in range(CASES):
            client.send(message(random, identifiers))
        number = next(number for number in server.get_clients() if server.visitors.has_control(number) is has_control)
        end = server.get_clients()[number].gui.add_checkbox("end", False)
        send(client, type="GuiUpdateMessage", uuid=end._impl.uuid, updates={"value": True})
        wait_for(lambda: end.value, "the message after all others", timeout=60.0)
        frame = session.frame
        assert session.step(1).exception(timeout=60.0) is None and session.frame is not frame
        if not has_control:
            assert session.config == small_config(), "a visitor without control has changed a parameter"
    failures = dashboard.failures
    dashboard.close()
    session.close()
    assert failures == 0
    assert "Traceback" not in caplog.text + capfd.readouterr().err
    assert not [record for record in caplog.records if record.exc_info]
