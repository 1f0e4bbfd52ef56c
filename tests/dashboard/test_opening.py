"""Opening of sources from the page, with real files and a real websocket."""

import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image
from small_source import small_config, small_source

from aero_viz.catalog import load_world, open_source, shipped_recordings
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.folders import Folders
from aero_viz.dashboard.links import Link, Opening
from aero_viz.dashboard.panels.source import SourcePanel
from aero_viz.dashboard.viser_private import identifier, inputs
from aero_viz.errors import UserError
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.reader_process import Reader, ReaderProcess, read_here
from aero_viz.scenes import World
from aero_viz.session import Session
from aero_viz.session.source import Conditions, Source
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for

SECRET = "hunter2"
LATE = threading.Event()
"""Ends the opening of the source "late"."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that the page may open, beside one that it may not."""
    for name in ("open", "closed"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "passwords.json").write_text(f'{{"{SECRET}": 1}}')
    world().save(tmp_path / "open" / "poles.json")
    world().save(tmp_path / "closed" / "poles.json")
    return tmp_path / "open"


def world() -> World:
    found = small_source().info.world
    assert found is not None
    return found


def slow_or_real(spec: str, /, *, seed: int, read: Reader = read_here, conditions: Conditions | None = None) -> Source:
    if spec == "slow":
        read(time.sleep, 600.0)
    if spec == "late":
        assert LATE.wait(60.0)
        return small_source(goal=11.0)
    return open_source(spec, seed=seed, read=read, conditions=conditions)


@pytest.fixture
def desk(folder: Path) -> Iterator[SimpleNamespace]:
    """A paused session, its dashboard, and a client that presses the buttons."""
    session = Session(small_source(goal=11.0), config=small_config())
    session.start(play=False)
    session.step(0).result()
    LATE.clear()
    choices = [("slow: takes for ever", "slow"), ("late: takes a while", "late")]
    dashboard = Dashboard(session, port=0, open_source=slow_or_real, choices=choices, folders=[folder])
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        wait_for(dashboard.server.get_clients, "the client")
        yield SimpleNamespace(session=session, dashboard=dashboard, client=client)
    dashboard.close()
    session.close()
    wait_for(nothing_is_being_opened, "the end of the opening")  # the next test counts the threads


def set_control(desk: SimpleNamespace, label: str, value: object) -> None:
    uuid = next(identifier(control) for control in controls(desk) if control.label == label)
    send(desk.client, type="GuiUpdateMessage", uuid=uuid, updates={"value": value})


def controls(desk: SimpleNamespace) -> list[Any]:
    return list(inputs(desk.dashboard.server.gui).values())


def scene_list(desk: SimpleNamespace) -> Any:
    return next(control for control in controls(desk) if control.label == "Scene")


def open_path(desk: SimpleNamespace, path: object) -> None:
    set_control(desk, "Path", str(path))
    set_control(desk, "Open path", True)


def source_panel(desk: SimpleNamespace) -> SourcePanel:
    return next(panel for panel in desk.dashboard.panels if isinstance(panel, SourcePanel))


def nothing_is_being_opened() -> bool:
    return "aero-viz-open" not in [thread.name for thread in threading.enumerate()]


def test_a_world_in_the_folder_is_opened(desk, folder):
    before = desk.session.source
    open_path(desk, folder / "poles.json")
    wait_for(lambda: desk.session.source is not before, "the world")
    assert desk.session.source.name == "poles"
    wait_for(nothing_is_being_opened, "the end of the opening")
    before = desk.session.source
    open_path(desk, "poles.json")  # relative to the folder
    wait_for(lambda: desk.session.source is not before, "the world again")


def test_a_file_is_listed_once_by_whatever_path_it_was_opened(desk, folder):
    (folder / "link.json").symlink_to("poles.json")
    for path in ("poles.json", folder / "poles.json", "./poles.json", "link.json"):
        before = desk.session.source
        open_path(desk, path)
        wait_for(lambda: desk.session.source is not before, "the world")  # noqa: B023
        wait_for(nothing_is_being_opened, "the end of the opening")
    desk.dashboard.drain()
    assert scene_list(desk).options == ("slow", "late", "poles.json")


def test_what_the_planner_knows_is_that_of_the_flight_and_nothing_for_a_recording(desk, folder):
    recording, _ = shipped_recordings()["forest_mid360"]
    shutil.copy(recording, folder)
    for name in ("poles.json", recording.name, "poles.json"):
        before = desk.session.source
        open_path(desk, name)
        wait_for(lambda before=before: desk.session.source is not before, name)
        known = config_for_flight(small_config(), desk.session.source)
        wait_for(lambda known=known: desk.session.config == known, "the configuration")
        wait_for(nothing_is_being_opened, "the end of the opening")
        assert (desk.session.config == small_config()) is (name == recording.name)


def test_what_the_planner_knows_is_no_change_of_parameters_in_the_flight(desk):
    before = desk.session.source
    open_path(desk, "poles.json")
    wait_for(lambda: desk.session.source is not before, "the world")
    wait_for(nothing_is_being_opened, "the end of the opening")
    assert desk.session.config != small_config() and desk.dashboard.drain()
    assert source_panel(desk).page.history.past().events == ()


def test_undo_leads_to_no_facts_of_another_flight(desk, folder):
    shutil.copy(shipped_recordings()["forest_mid360"][0], folder)
    desk.session.configure({"costs.q_track": 1.0})
    before = desk.session.source
    open_path(desk, "forest_mid360.mcap")
    wait_for(lambda: desk.session.source is not before, "the recording")
    wait_for(nothing_is_being_opened, "the end of the opening")
    assert desk.session.undo() == small_config()
    assert desk.session.undo() == small_config()


def test_a_malformed_file_is_explained_in_the_terminal_only(desk, folder, caplog):
    open_path(desk, folder / "passwords.json")
    heard = read_until(desk.client, "the terminal shows why")
    assert SECRET not in heard
    assert SECRET in caplog.text and "Traceback" not in caplog.text


@pytest.mark.parametrize("name", ["passwords.json", "poles.json", "password.json", "absent.json", "", "absent/../"])
def test_other_folders_are_closed_and_nothing_is_told_about_them(desk, folder, caplog, name):
    path = folder.parent / "closed" / name
    open_path(desk, path)
    heard = read_until(desk.client, f"There is no file {path} in {folder.name}, where this page may open files")
    assert "passwords" not in heard.replace(str(path), "") and SECRET not in heard + caplog.text


def test_a_pipe_is_refused_at_once(desk, folder):
    os.mkfifo(folder / "pipe.json")
    open_path(desk, folder / "pipe.json")
    read_until(desk.client, "neither a file nor a folder with a recording")


def test_opening_can_be_cancelled_and_many_clicks_open_one_source(desk, folder):
    before = desk.session.source
    for _ in range(50):
        set_control(desk, "Open", True)
    read_until(desk.client, "A source is being opened; cancel that first.")
    assert [thread.name for thread in threading.enumerate()].count("aero-viz-open") == 1
    set_control(desk, "Cancel opening", True)
    read_until(desk.client, "slow was not opened")
    assert desk.session.source is before
    open_path(desk, folder / "poles.json")
    wait_for(lambda: desk.session.source is not before, "another source")


@pytest.mark.parametrize("command", ["set_source", "configure"])
def test_a_click_while_a_source_is_about_to_be_shown_opens_the_next_one(desk, folder, monkeypatch, command):
    run_command, is_read, go_on = getattr(Session, command), threading.Event(), threading.Event()

    def hold(*arguments, **options):
        is_read.set()
        assert go_on.wait(60.0)
        return run_command(*arguments, **options)

    monkeypatch.setattr(Session, command, hold)
    LATE.set()
    source_panel(desk).open_link(Link(Opening("late")), None)
    assert is_read.wait(60.0)
    open_path(desk, folder / "poles.json")
    wait_for(lambda: str(folder / "poles.json") in [control.value for control in controls(desk)], "the path")
    time.sleep(0.5)  # longer than the page gives a typed value, so that the click would be refused
    go_on.set()
    wait_for(lambda: source_panel(desk).opening.spec == str(folder / "poles.json"), "the next source")


def test_a_source_that_is_complete_when_its_opening_is_cancelled_is_not_shown(desk):
    before = desk.session.source
    source_panel(desk).open_link(Link(Opening("late")), None)
    read_until(desk.client, "Opening late ..")
    set_control(desk, "Cancel opening", True)
    set_control(desk, "Cancel opening", True)
    set_control(desk, "Seed", 7919)  # no other control has this value
    wait_for(lambda: 7919 in [control.value for control in controls(desk)], "all messages")
    LATE.set()
    read_until(desk.client, "late was not opened")
    wait_for(nothing_is_being_opened, "the end of the opening")
    assert desk.session.source is before


def test_a_flight_to_the_time_of_a_link_can_be_cancelled(desk):
    LATE.set()
    source_panel(desk).open_link(Link(Opening("late"), time=1000.0, config={"vehicle.speed_limit": 0.5}), None)
    wait_for(lambda: desk.session.frame.time > 0.2, "the flight", timeout=60.0)
    set_control(desk, "Cancel opening", True)
    wait_for(nothing_is_being_opened, "the end of the opening", timeout=60.0)
    assert desk.session.frame.outcome is None


def test_the_session_ticks_while_a_source_is_being_opened(desk):
    set_control(desk, "Open", True)
    read_until(desk.client, "Opening slow ..")
    index = desk.session.frame.index
    desk.session.step(20).result(timeout=60.0)
    assert desk.session.frame.index == index + 20


def test_a_dashboard_that_closes_ends_the_opening(folder):
    session = Session(small_source(), config=small_config())
    dashboard = Dashboard(session, port=0, open_source=slow_or_real, choices=[("slow: ", "slow")], folders=[folder])
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        wait_for(dashboard.server.get_clients, "the client")
        set_control(SimpleNamespace(dashboard=dashboard, client=client), "Open", True)
        read_until(client, "Opening slow ..")
    dashboard.close()
    wait_for(nothing_is_being_opened, "the end of the opening")
    session.close()


def test_links_do_not_lead_out_of_the_folders(folder):
    outside, folders = folder.parent / "closed", Folders([folder])
    (folder / "link.json").symlink_to(outside / "poles.json")
    (folder / "linked").symlink_to(outside)
    (folder / "bag").mkdir()
    (folder / "bag" / "metadata.yaml").write_text("")
    assert folders.find("bag") == (folder / "bag").resolve()
    (folder / "bag" / "flight.mcap").symlink_to(outside / "poles.json")
    for name in (
        "link.json",
        "linked/poles.json",
        "bag",
        "../closed/poles.json",
        "linked",
        "\0",
        "x" * 5000,
        "~nobody",
    ):
        with pytest.raises(UserError, match="There is no file"):
            folders.find(name)


@pytest.mark.parametrize("place", ["data", "data/velodyne"])
def test_links_below_the_first_level_do_not_lead_out(folder, place):
    (bag := folder / "bag").mkdir()
    (bag / "flight.mcap").write_bytes(b"")
    (bag / place).mkdir(parents=True)
    (bag / "around").symlink_to(bag)  # a circle ends
    assert Folders([folder]).find("bag") == bag.resolve()
    (bag / place / "000000.bin").symlink_to(folder.parent / "closed" / "poles.json")
    with pytest.raises(UserError, match="There is no file bag"):
        Folders([folder]).find("bag")


def test_a_folder_in_the_place_of_a_file_makes_no_recording(folder):
    (folder / "bag" / "metadata.yaml").mkdir(parents=True)
    with pytest.raises(UserError, match="is a folder without a recording"):
        Folders([folder]).find("bag")


def test_a_companion_that_leads_out_is_not_read(folder):
    """The page may open the image, and the link beside it looks like its settings."""
    closed = folder.parent / "closed"
    (closed / "maze.yaml").write_text("image: maze.png\nresolution: secret\n")
    Image.new("L", (40, 40), 255).save(folder / "maze.png")
    (folder / "maze.yaml").symlink_to(closed / "maze.yaml")
    read = ReaderProcess(folders=[folder])
    with pytest.raises(UserError, match="no such file in the folders that may be read"):
        read(load_world, str(folder / "maze.png"))
    (folder / "maze.yaml").unlink()
    assert len(read(load_world, str(folder / "maze.png")).boxes) > 0


def test_a_folder_that_is_itself_a_link_is_open(folder):
    (link := folder.parent / "link").symlink_to(folder)
    assert Folders([link]).find(str(link / "poles.json")) == (folder / "poles.json").resolve()


def test_a_folder_without_a_recording_is_refused(folder):
    with pytest.raises(UserError, match="is a folder without a recording"):
        Folders([folder]).find(str(folder))


def test_without_folders_no_file_is_open(folder):
    with pytest.raises(UserError, match=r"json that this page may open\. Start aero-viz with --folder DIR"):
        Folders([folder / "absent"]).find(str(folder / "poles.json"))


def test_folders_of_one_name_are_told_apart_by_those_above_them(tmp_path):
    paths = [tmp_path / "mine" / "datasets", tmp_path / "shipped" / "datasets", tmp_path / "bad"]
    for path in paths:
        path.mkdir(parents=True)
    with pytest.raises(UserError, match="no file x in mine/datasets or shipped/datasets or bad, where"):
        Folders(paths).find("x")
