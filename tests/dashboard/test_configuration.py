"""Texts of the page about a configuration, without a browser."""

import re
import threading
from collections.abc import Mapping
from html import unescape
from typing import Any

from small_source import small_config, small_source
from websockets.sync.connection import Connection

from aero_planner.config import DroneConfig, PlannerConfig
from aero_planner.config.file import load_config
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels.configuration import Baseline, differences
from aero_viz.dashboard.preset_store import PresetStore
from aero_viz.dashboard.viser_private import identifier, inputs
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for


def test_differences_show_old_and_new_value_and_the_flags():
    config = PlannerConfig().replace({"costs.q_track": 7.5, "candidates.previous": False})
    html = differences(config, Baseline.from_config(PlannerConfig()))
    text = re.sub("<[^>]*>", " ", html)
    assert "3.0 → 7.5" in text and "True → False" in text
    assert "--costs.q-track 7.5" in text and "--candidates.previous False" in text


def test_the_default_differs_in_nothing():
    assert differences(PlannerConfig(), Baseline.from_config(PlannerConfig())) == ""


def test_changes_of_another_preset_can_be_pasted_as_flags_and_as_a_file(tmp_path):
    paper = PlannerConfig.preset("paper")
    config = paper.replace(
        {
            "costs.q_track": 7.5,
            "costs.shape": "quadratic",
            "candidates.previous": True,
            "stages.active": "memory, way_out",
        }
    )
    html = differences(config, Baseline.from_config(paper))
    flags, text = (re.search(f'aero-{name}"[^>]*>([^<]*)<', html) for name in ("flags", "yaml"))
    assert flags is not None and text is not None
    assert flags[1].startswith("--config paper ") and "--costs.shape quadratic" in flags[1]
    assert "--stages.active 'way_out, memory'" in unescape(flags[1]), "one word of a shell"
    (tmp_path / "pasted.yaml").write_text(unescape(text[1]))
    assert load_config(tmp_path / "pasted.yaml") == config


class WaitingSession(Session):
    """A session that takes a configuration only after an event."""

    is_asked, may_configure = threading.Event(), threading.Event()

    def configure(self, change: DroneConfig | Mapping[str, Any]) -> DroneConfig:
        self.is_asked.set()
        assert self.may_configure.wait(60.0)
        return super().configure(change)


def uuid_of(dashboard: Dashboard, label: str) -> str:
    """Return what messages of the page call a control."""
    controls = inputs(dashboard.server.gui)
    return next(uuid for uuid, control in controls.items() if getattr(control, "label", "") == label)


def press(dashboard: Dashboard, client: Connection, label: str) -> None:
    """Press a button."""
    send(client, type="GuiUpdateMessage", uuid=uuid_of(dashboard, label), updates={"value": True})


def test_a_saved_preset_is_confirmed_and_replaced_only_after_a_question(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    session, store = Session(small_source(), config=small_config()), PresetStore()
    session.tick()
    dashboard = Dashboard(session, port=0)
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        wait_for(dashboard.server.get_clients, "the client")
        name = uuid_of(dashboard, "Name")
        send(client, type="GuiUpdateMessage", uuid=name, updates={"value": "mine"})
        press(dashboard, client, "Save preset")
        read_until(client, "The preset 'mine' was saved.")
        before = store.load("mine").config
        session.configure({"costs.q_track": 7.5})
        press(dashboard, client, "Save preset")
        heard = read_until(client, "Keep it")
        assert "Replace this preset?" in heard and store.load("mine").config == before
        (page,) = dashboard.server.get_clients().values()
        answers = inputs(page.gui)
        (answer,) = (
            uuid for uuid, control in answers.items() if getattr(control, "options", ()) == ("Replace", "Keep it")
        )
        send(client, type="GuiUpdateMessage", uuid=answer, updates={"value": "Replace"})
        read_until(client, "The preset 'mine' was saved.")
        assert store.load("mine").config.costs.q_track == 7.5
    dashboard.close()
    session.close()


def upload(dashboard: Dashboard, client: Connection, content: bytes) -> None:
    """Send a file as the button for it does."""
    button = uuid_of(dashboard, "Upload YAML")
    send(
        client, type="FileTransferStartUpload", source_component_uuid=button, transfer_uuid="a",
        filename="a.yaml", mime_type="", part_count=1, size_bytes=len(content),
    )  # fmt: skip
    send(
        client, type="FileTransferPart", source_component_uuid=button, transfer_uuid="a", part_index=0,
        content=content,
    )  # fmt: skip


def test_an_uploaded_file_keeps_what_is_known_about_the_flight():
    session = Session(small_source(), config=small_config())
    session.tick()
    dashboard = Dashboard(session, port=0)
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        upload(dashboard, client, b"costs:\n  q_track: 7.5\n")
        wait_for(lambda: session.config.costs.q_track == 7.5, "the configuration")
    changed = PlannerConfig().replace({"costs.q_track": 7.5})
    assert session.config == config_for_flight(changed, session.source) != changed
    dashboard.close()
    session.close()


def test_what_is_known_about_the_flight_follows_a_parameter_that_is_changed_on_the_page():
    session = Session(small_source(), config=config_for_flight(small_config(), small_source().info))
    session.tick()
    dashboard = Dashboard(session, port=0)
    box = uuid_of(dashboard, PlannerConfig.find("costs.use_ground").title)
    known, height = session.config, "costs.height_max"
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        send(client, type="GuiUpdateMessage", uuid=box, updates={"value": False})
        wait_for(lambda: not session.config.costs.use_ground, "the ground to be ignored")
        assert session.config.get(height) == PlannerConfig().get(height) != known.get(height)
        send(client, type="GuiUpdateMessage", uuid=box, updates={"value": True})
        wait_for(lambda: session.config == known, "the top of the world to be known again")
    dashboard.close()
    session.close()


def test_the_page_is_told_not_to_call_the_upload_of_a_refused_file_successful():
    session = Session(small_source(), config=small_config())
    session.tick()
    dashboard = Dashboard(session, port=0)
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        wait_for(dashboard.server.get_clients, "the client")
        upload(dashboard, client, b"costs:\n  q_track: -3\n")
        heard = read_until(client, "upload-a", timeout=60.0)
    assert "RemoveNotificationMessage" in heard and "must be a number in" in heard
    dashboard.close()
    session.close()


def test_the_page_answers_while_an_uploaded_file_is_read():
    session = WaitingSession(small_source(), config=small_config())
    dashboard = Dashboard(session, port=0)
    box = dashboard.server.gui.add_checkbox("box", False)

    @box.on_update
    async def _(_: object) -> None:
        session.may_configure.set()

    with join(dashboard.server) as client:
        send(client, **CAMERA)
        upload(dashboard, client, b"costs:\n  q_track: 7.5\n")
        wait_for(session.is_asked.is_set, "the file to be read")
        send(client, type="GuiUpdateMessage", uuid=identifier(box), updates={"value": True})
        wait_for(lambda: session.config.costs.q_track == 7.5, "the configuration")
    dashboard.close()
    session.close()
