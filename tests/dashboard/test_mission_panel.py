"""Waypoints that are added, moved, reordered, removed, saved and read on the page, without a browser."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import viser
from small_source import small_config, small_source

from aero_planner.mission_progress import MissionProgress
from aero_planner.missions import Mission, Waypoint
from aero_viz.cli.missions import load_mission
from aero_viz.dashboard import Dashboard, palette
from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.layers.mission import MissionLayer, shown_waypoints
from aero_viz.dashboard.panels.mission_edits import above_ground, added, moved, removed, replaced, swapped
from aero_viz.dashboard.panels.mission_text import describe, format_mission, parse_mission
from aero_viz.dashboard.viser_private import identifier, inputs
from aero_viz.errors import UserError
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, read_until, send, wait_for


def mission(*texts: str) -> Mission:
    return Mission(tuple(map(Waypoint.parse, texts)))


@pytest.fixture
def desk() -> Iterator[SimpleNamespace]:
    """A paused flight to a goal at x = 12 m, its dashboard, and a client of the page."""
    session = Session(small_source(), config=small_config())
    session.start(play=False)
    session.step(0).result()
    dashboard = Dashboard(session, port=0)
    with join(dashboard.server) as client:
        send(client, **CAMERA)
        wait_for(dashboard.server.get_clients, "the client")
        yield SimpleNamespace(session=session, dashboard=dashboard, client=client)
    dashboard.close()
    session.close()


def control(desk: SimpleNamespace, label: str) -> Any:
    return next(c for c in inputs(desk.dashboard.server.gui).values() if getattr(c, "label", "") == label)


def give(desk: SimpleNamespace, label: str, value: object) -> None:
    """Set a control as the page does."""
    send(desk.client, type="GuiUpdateMessage", uuid=identifier(control(desk, label)), updates={"value": value})


def order(desk: SimpleNamespace, action: str) -> None:
    group = next(c for c in inputs(desk.dashboard.server.gui).values() if getattr(c, "options", ())[-1:] == ("remove",))
    send(desk.client, type="GuiUpdateMessage", uuid=identifier(group), updates={"value": action})


def progress(desk: SimpleNamespace) -> MissionProgress:
    return desk.session.frame.observation.mission


def fly(desk: SimpleNamespace, *texts: str) -> None:
    """Fly another mission, and wait until the page shows it."""
    desk.session.alter(lambda source: source.set_mission(mission(*texts))).result()
    wait_for(lambda: control(desk, "Waypoint").max == len(texts), "the mission on the page")


def xs(desk: SimpleNamespace) -> list[float]:
    return [waypoint.position[0] for waypoint in progress(desk).mission.waypoints]


def shows(desk: SimpleNamespace, number: int, *expected: float) -> Callable[[], bool]:
    return lambda: xs(desk) == list(expected) and control(desk, "Waypoint").value == number


def test_a_waypoint_is_reordered_and_removed_and_the_selection_follows_it(desk):
    fly(desk, "3,3,2", "6,4,2", "12,0,2")
    order(desk, "move down")
    wait_for(shows(desk, 2, 6.0, 3.0, 12.0), "the first waypoint behind the second one")
    order(desk, "move down")
    wait_for(shows(desk, 3, 6.0, 12.0, 3.0), "it at the end")
    order(desk, "move up")
    order(desk, "move up")
    wait_for(shows(desk, 1, 3.0, 6.0, 12.0), "it at the beginning, after two clicks in a row")
    give(desk, "Waypoint", 2)
    wait_for(lambda: control(desk, "Place [m]").value == (6.0, 4.0, 2.0), "the second one")
    order(desk, "remove")
    wait_for(shows(desk, 2, 3.0, 12.0), "the removal")
    give(desk, "Waypoint", 1)
    wait_for(shows(desk, 1, 3.0, 12.0), "the first one")
    order(desk, "move up")
    read_until(desk.client, "Waypoint 1 is already the next one.")
    order(desk, "remove")
    wait_for(shows(desk, 1, 12.0), "the other removal")
    order(desk, "remove")
    read_until(desk.client, "add one before you remove this one")
    assert xs(desk) == [12.0]


def test_numbers_change_the_selected_waypoint_and_a_refusal_says_why_and_brings_them_back(desk):
    fly(desk, "3,3,2", "12,0,2")
    give(desk, "Radius [m]", 0.5)
    give(desk, "Leg speed [m/s]", 2.5)
    give(desk, "Stop there", True)
    give(desk, "Place [m]", (4.0, 2.0, 3.0))
    changed = Waypoint((4.0, 2.0, 3.0), radius=0.5, speed=2.5, stop=True)
    wait_for(lambda: progress(desk).waypoint == changed, "the changes")
    assert tuple(desk.session.frame.observation.goal.position) == (4.0, 2.0, 3.0)
    assert desk.session.frame.config.vehicle.speed_limit == 2.5
    give(desk, "Radius [m]", 0.0)
    read_until(desk.client, "radius is 0; it must be greater than 0")
    wait_for(lambda: control(desk, "Radius [m]").value == 0.5, "the radius to return")
    give(desk, "Place [m]", (4.0, 2.0, 300.0))
    read_until(desk.client, "Waypoint 1 of 2, (4, 2, 300), lies outside")
    wait_for(lambda: control(desk, "Place [m]").value == (4.0, 2.0, 3.0), "the place to return")
    give(desk, "Leg speed [m/s]", 0.0)
    wait_for(lambda: progress(desk).waypoint.speed is None, "no limit of its own")


def test_what_is_behind_the_drone_stays_and_an_earlier_tick_shows_its_own_mission(desk):
    fly(desk, "1.5,0,2", "6,4,2", "12,0,2")
    session = desk.session
    while progress(desk).index == 0:
        session.step().result()
    wait_for(lambda: control(desk, "Waypoint").value == 2, "the present one on the page")
    order(desk, "move down")
    wait_for(shows(desk, 3, 1.5, 12.0, 6.0), "the other order")
    assert progress(desk).passed == 1 and progress(desk).events[0].waypoint == 0
    session.seek(0.0).result()
    wait_for(shows(desk, 3, 1.5, 6.0, 12.0), "the mission of the first tick")


def upload(desk: SimpleNamespace, content: bytes) -> None:
    button = identifier(control(desk, "Upload mission"))
    send(
        desk.client, type="FileTransferStartUpload", source_component_uuid=button, transfer_uuid="a",
        filename="tour.yaml", mime_type="", part_count=1, size_bytes=len(content),
    )  # fmt: skip
    send(
        desk.client, type="FileTransferPart", source_component_uuid=button, transfer_uuid="a", part_index=0,
        content=content,
    )  # fmt: skip


def test_a_mission_is_downloaded_and_uploaded(desk):
    fly(desk, "3,3,2,radius=0.5", "6,4,2,stop,speed=2", "12,0,2")
    before = progress(desk).mission
    give(desk, "Download mission", True)
    assert "mission.yaml" in read_until(desk.client, "mission.yaml")
    desk.session.set_goal((9.0, 0.0, 2.0)).result()
    upload(desk, format_mission(before).encode())
    wait_for(lambda: progress(desk).mission == before, "the mission of the file")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"waypoints:\n  - {position: [5, 0, 300]}\n  - {position: [9, 0, 2]}\n", "Waypoint 1 of 2, (5, 0, 300), lies"),
        (b"waypoints: [{position: [5, 0]}]", "tour.yaml: waypoint 1: the position is"),
        (b"waypoints: [", "tour.yaml is not YAML"),
        (b"\xff\xfe", "tour.yaml is no text"),
    ],
)
def test_a_file_that_is_no_mission_is_refused_and_the_mission_stays(desk, content, problem):
    upload(desk, content)
    read_until(desk.client, problem)
    assert xs(desk) == [12.0]


def test_a_file_of_the_page_is_one_for_the_flag(tmp_path: Path):
    tour = mission("10,5.5,2,stop", "20,-5,2.5,radius=0.5,speed=3,timeout=20", "45,0,2")
    path = tuple((float(t), 40.0 + t, 1.0, 2.0) for t in range(4))
    tour = Mission((*tour.waypoints, Waypoint(path[-1][1:], path=path)))
    (tmp_path / "tour.yaml").write_text(format_mission(tour), encoding="utf-8")
    assert load_mission(tmp_path / "tour.yaml") == tour
    assert parse_mission(viser.UploadedFile("tour.yaml", format_mission(tour).encode())) == tour


def test_edits_concern_the_waypoints_ahead():
    def edited(edit: Any, index: int = 1) -> tuple[list[float], int]:
        waypoints = list(mission("1,0,2", "2,0,2", "3,0,2").waypoints)
        selected = edit(waypoints, index)
        return [waypoint.position[0] for waypoint in waypoints], selected

    assert edited(added((9.0, 0.0, 2.0))) == ([1.0, 2.0, 9.0, 3.0], 2)
    assert edited(added((9.0, 0.0, 2.0)), 3) == ([1.0, 2.0, 3.0, 9.0], 3)
    assert edited(moved(2, (7.0, 0.0, 2.0))) == ([1.0, 2.0, 7.0], 2)
    assert edited(swapped(1, 2)) == ([1.0, 3.0, 2.0], 2)
    assert edited(removed(2)) == ([1.0, 2.0], 1)
    for edit in (moved(0, (7.0, 0.0, 2.0)), removed(0), swapped(0, 1), replaced(0, lambda waypoint: waypoint)):
        with pytest.raises(UserError, match="Waypoint 1 is not ahead"):
            edited(edit)
    with pytest.raises(UserError, match="already the next"):
        edited(swapped(1, 0))
    with pytest.raises(UserError, match="already the last"):
        edited(swapped(2, 3))
    path = tuple((float(t), float(t), 0.0, 2.0) for t in range(3))
    waypoints = [Waypoint(path[-1][1:], path=path)]
    moved(0, (5.0, 1.0, 2.0))(waypoints, 0)
    assert waypoints[0].position == (5.0, 1.0, 2.0) and waypoints[0].path[0] == (0.0, 3.0, 1.0, 2.0)


def test_a_click_gives_the_place_above_the_ground_at_the_height_of_the_goal(desk):
    observation = desk.session.frame.observation
    assert above_ground(observation, (0.0, 0.0, 10.0), (1.0, 0.5, -2.0)) == pytest.approx((5.0, 2.5, 2.0))
    with pytest.raises(UserError, match="below the horizon"):
        above_ground(observation, (0.0, 0.0, 10.0), (1.0, 0.5, 0.1))


def given_up() -> MissionProgress:
    """A mission of which the first waypoint was passed and the second one given up."""
    tour = MissionProgress(mission("2,0,2", "4,9,2,timeout=3", "6,0,2", "12,0,2"))
    return tour.advance(0.0, (1.0, 0.0, 2.0), 1.0).advance(1.0, (3.0, 0.0, 2.0), 1.0).give_up(5.0)


def test_the_table_has_length_time_states_and_reasons():
    text = describe(given_up(), (0.0, 0.0, 2.0), 2.0)
    assert given_up().index == 2 and given_up().passed == 1
    length = given_up().mission.length((0.0, 0.0, 2.0))
    assert f"{length:.1f}" in text and f"{length / 2.0:.0f}" in text and "of 4" in text
    assert [text.count(f">{word}<") for word in ("passed", "given up", "next", "ahead")] == [2, 1, 1, 1]
    assert "was given up after 5.00 s: the drone has not come nearer" in text


def test_the_layer_tells_waypoints_passed_given_up_present_and_ahead_apart(server, desk):
    frame = desk.session.frame
    layer = MissionLayer(server)
    assert layer.legend(frame) == [] and not shown_nodes(layer.update(frame)), "a single goal has its own layer"
    state = given_up()
    frame = dataclasses.replace(frame, observation=dataclasses.replace(frame.observation, mission=state))
    changes = layer.update(frame)
    apply(changes)
    nodes = {handle.name: handle for handle, _, _ in changes}
    drawn = {name: nodes[f"/mission/{name}"] for name in ("way", "passed", "ahead", "present")}
    assert all(node.visible for node in drawn.values())

    def middle(name: str) -> np.ndarray:
        return np.unique(drawn[name].points.reshape(-1, 3), axis=0).mean(axis=0)

    np.testing.assert_allclose(middle("passed"), (2.0, 0.0, 2.0), atol=0.05)
    np.testing.assert_allclose(middle("present"), (6.0, 0.0, 2.0), atol=0.05)
    np.testing.assert_allclose(drawn["way"].points[:3, 0], [w.position for w in state.mission.waypoints[:3]])
    assert (drawn["passed"].colors == palette.unmapped(palette.DRONE)).all()
    numbers = [handle for name, handle in nodes.items() if "number" in name]
    assert [(n.text, tuple(n.position), n.visible) for n in numbers] == [
        (f"{i}", pytest.approx(w.position), True) for i, w in enumerate(state.mission.waypoints, 1)
    ]
    assert len(layer.legend(frame)) == 2
    assert layer.update(frame) == [], "the same state is not sent again"
    apply(layer.update(desk.session.frame))
    assert not any(node.visible for node in (*drawn.values(), *numbers)), "nothing of a single goal"


def shown_nodes(changes: list[Any]) -> list[str]:
    return [handle.name for handle, name, value in changes if name == "visible" and value]


def test_of_a_long_mission_those_around_the_drone_are_shown():
    tour = mission(*(f"{x},0,2" for x in range(500)))
    assert shown_waypoints(MissionProgress(tour)) == range(0, 100)
    assert shown_waypoints(MissionProgress(tour, 200)) == range(180, 280)
    assert shown_waypoints(MissionProgress(tour, 500)) == range(400, 500)
    assert shown_waypoints(MissionProgress(mission("1,0,2"), 1)) == range(0, 1)
