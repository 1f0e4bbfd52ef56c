"""Scenes, worlds and recordings opened in the page, and the display of a recording."""

import contextlib
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.catalog import shipped_recordings
from aero_viz.flight import fly
from aero_viz.scenes import SCENES, World, scene
from tests.browser.desk import Desk, open_desk
from tests.browser.pictures import differing


def choose(desk: Desk, name: str) -> None:
    """Open a source on offer as a user does: unfold the list, choose an entry, press the button."""
    desk.choose("Scene", name)
    if name in SCENES:  # its description may have another number of lines, which moves the button
        desk.page.get_by_text(SCENES[name].description).wait_for()
    desk.page.get_by_role("button", name="Open", exact=True).click()


def solids(desk: Desk) -> np.ndarray:
    """The obstacles alone, from behind the drone."""
    desk.dashboard.show_only(["obstacles"])
    position = np.asarray(desk.session.frame.observation.state.position)  # type: ignore[union-attr]
    return desk.render(np.add(position, (-4.0, 0.0, 3.0)), np.add(position, (4.0, 0.0, 0.0)))


def test_another_scene_and_a_world_from_a_file_are_chosen_in_the_page(restored_desk, tmp_path):
    desk = restored_desk
    forest = solids(desk)
    choose(desk, "pillars")
    desk.page.get_by_text("A room with 6 pillars").wait_for()
    desk.wait_for(lambda: desk.session.frame.source.name.startswith("pillars"), "the room")
    room = solids(desk)
    assert differing(room, forest) > 20_000
    index = desk.session.frame.index
    desk.click("+1")
    desk.wait_for(lambda: desk.session.frame.index == index + 1, "a tick in the room")

    field = desk.control("Seed").locator("input")
    desk.enter(field, "3")
    choose(desk, "forest")
    desk.wait_for(lambda: desk.session.frame.source.name == "forest-100-3", "another forest")

    path = tmp_path / "gate.json"
    gate = np.array([[4.0, y, 0.0, 0.0, 0.0, 1.0, 0.3, 4.0] for y in (-1.5, 1.5)])
    World("two posts", np.array([0.0, 0.0, 2.0]), np.array([9.0, 0.0, 2.0]), cylinders=gate).save(path)
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    desk.wait_for(lambda: desk.session.frame.source.name == "two posts", "the world of the file")
    desk.page.get_by_text("two posts").first.wait_for()
    assert differing(solids(desk), room) > 20_000
    assert desk.console == []
    assert desk.dashboard.failures == 0


def test_a_seed_that_is_opened_flies_as_on_the_command_line(restored_desk):
    desk = restored_desk
    desk.session.play()
    field = desk.control("Seed").locator("input")
    desk.enter(field, "3")
    choose(desk, "pillars")
    desk.wait_for(lambda: desk.session.frame.source.name.startswith("pillars"), "the room")
    desk.session.set_speed(10.0)
    desk.wait_for(lambda: desk.session.frame.outcome is not None, "the end of the flight")
    path = []
    recorder: Any = SimpleNamespace(write=lambda _: None, write_pose=lambda _, state: path.append(state.position))
    fly(scene("pillars", seed=3), seed=3, recorder=contextlib.nullcontext(recorder))
    np.testing.assert_array_equal(desk.session.frame.trail, path)


def test_a_mesh_is_seen_from_both_sides_and_its_ground_height_is_known(restored_desk, tmp_path):
    desk = restored_desk
    wall = np.array([[5.0, -3.0, -10.0, 5.0, 3.0, -10.0, 5.0, 0.0, -4.0]])
    ground = np.array([[5.0, 0.0, -10.5, 60.0, 60.0, 1.0, 0.0]])
    ends = np.array([[0.0, 0.0, -8.0], [10.0, 0.0, -8.0]])
    World("one triangle", *ends, boxes=ground, triangles=wall).save(path := tmp_path / "mesh.json")
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    desk.wait_for(lambda: desk.session.frame.source.name == "one triangle", "the mesh")
    assert desk.session.frame.observation.ground_height == -10.0
    desk.dashboard.show_only(["obstacles"])
    for position, look_at in (ends, ends[::-1]):
        desk.wait_for(lambda: (desk.render(position, look_at)[..., 3] > 128).sum() > 5000, f"the wall from {position}")  # noqa: B023
    assert desk.dashboard.failures == 0


def test_a_world_whose_start_is_in_an_obstacle_explains_why_it_ends_at_once(restored_desk, tmp_path):
    desk = restored_desk
    path = tmp_path / "stuck.json"
    World("stuck", np.zeros(3), np.array([9.0, 0.0, 0.0]), spheres=np.array([[0.1, 0.0, 0.0, 0.5]])).save(path)
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    words = re.compile("The start .*inside an obstacle")
    desk.page.get_by_text(words).first.wait_for()  # beside the outcome
    desk.click("Play")
    notification = desk.page.locator(".mantine-Notification-root", has_text=words)
    notification.first.wait_for()
    assert "collided" in notification.first.inner_text()


@pytest.fixture(scope="module")
def recording(browser, shared_datasets):
    """A real recording, opened in the page of another source, with the literal planner of the paper."""
    with open_desk(browser, ticks=1, config=PlannerConfig.preset("paper"), size=(1280, 720), layers=["drone"]) as desk:
        desk.control("Path").locator("input").fill(str(shared_datasets / "hilti_os0_A_mcap"))
        desk.click("Open path")
        desk.wait_for(lambda: not desk.session.source.closed_loop, "the recording")
        desk.wait_for(lambda: desk.control("Time [s]").is_visible(), "its time line")
        yield desk
        assert desk.console == []
        assert desk.dashboard.failures == 0


def test_a_recording_is_marked_as_open_loop(recording):
    recording.page.get_by_text("Open loop: motion and clouds are recorded; the plan is computed now").wait_for()
    recording.page.get_by_text("hilti_os0_A_mcap").first.wait_for()


def test_a_flight_log_opens_with_the_plan_that_was_flown_and_the_one_of_now(restored_desk):
    desk = restored_desk
    desk.dashboard.show_only(None)
    path, _ = shipped_recordings()["room_mid360"]
    desk.control("Path").locator("input").fill(str(path))
    desk.click("Open path")
    desk.wait_for(lambda: desk.session.frame.recorded_plan is not None, "the log")
    desk.page.get_by_text(
        "the recorded plan are those of the log; anchors, guides and rollouts are planned now"
    ).wait_for()
    layers = desk.dashboard.layers
    assert all(layers[name].visible for name in ("rollouts", "guides", "anchors", "recorded_plan"))


def test_restart_after_the_end_flies_again(restored_desk, tmp_path):
    desk, session = restored_desk, restored_desk.session
    World("near", np.array([0.0, 0.0, 2.0]), np.array([1.5, 0.0, 2.0])).save(tmp_path / "near.json")
    desk.control("Path").locator("input").fill(str(tmp_path / "near.json"))
    desk.click("Open path")
    desk.wait_for(lambda: session.frame.source.name == "near", "the world")
    desk.click("Play")
    desk.wait_for(lambda: session.frame.outcome == "arrived" and not session.playing, "the end")
    end = session.frame
    desk.click("Restart")
    desk.wait_for(lambda: session.frame.epoch != end.epoch and session.frame.index > 3, "the flight again")
    desk.wait_for(lambda: session.frame.outcome == "arrived", "its end")


def test_the_cloud_of_a_recording_is_drawn(recording):
    recording.dashboard.show_only([])
    empty = recording.settled_screenshot()
    recording.dashboard.show_only(["cloud"])
    recording.wait_for(lambda: differing(recording.screenshot(), empty) > 5000, "the cloud")


def test_all_fifteen_rollouts_of_a_recording_are_drawn_in_their_colours(recording):
    recording.dashboard.show_only(["rollouts"])
    frame = recording.session.frame
    plan, start = frame.plan, np.asarray(frame.observation.state.position)
    assert len(plan.positions) == 15
    middle = plan.positions[:, -1].mean(axis=0)
    away = (start - middle) / np.linalg.norm(start - middle)
    position, look_at = start + 3.0 * away + (0.0, 0.0, 2.0), start - 1.5 * away
    recording.wait_for_rollouts(position, look_at)


def test_a_recording_offers_only_the_layers_it_has_data_for(recording):
    recording.dashboard.show_only(None)
    recording.open_tab("Layers")
    for title, is_offered in (("Recorded path", True), ("LiDAR cloud", True), ("Obstacles (ground truth)", False)):
        recording.wait_for(lambda: recording.checkbox(title).is_visible() == is_offered, title)  # noqa: B023
    box = recording.checkbox("Recorded path")
    recording.dashboard.show_only([])
    recording.wait_for(lambda: not box.is_checked(), "the switch to be off")
    empty = recording.settled_screenshot()
    box.click()
    recording.wait_for(lambda: differing(recording.screenshot(), empty) > 50, "the recorded path")
    box.click()
    recording.wait_for(lambda: differing(recording.screenshot(), empty) == 0, "the path to be gone")


def test_a_recording_plays_to_its_end(recording):
    recording.dashboard.show_only(["rollouts", "drone"])
    recording.session.set_speed(4.0)
    recording.click("Play")
    recording.page.get_by_text("end of the recording").first.wait_for()
    recording.wait_for(lambda: recording.session.frame.outcome == "end", "the end")
    assert recording.session.frame.time == pytest.approx(11.5, abs=0.1)
    recording.click("-1")
    recording.wait_for(lambda: recording.session.frame.outcome is None, "one tick back")


def test_enter_opens_a_path_and_the_list_shows_what_is_open(fresh_desk, tmp_path):
    desk = fresh_desk
    World("a far goal", np.array([0.0, 0.0, 2.0]), np.array([30.0, 0.0, 2.0])).save(tmp_path / "far.json")
    field, shown = desk.control("Path").locator("input"), desk.control("Scene").locator("input").first
    desk.wait_for(lambda: shown.input_value() == "forest", "the list to show what is open at first")
    desk.enter(field, tmp_path / "far.json")
    desk.wait_for(lambda: desk.session.frame.source.name == "a far goal", "the world")
    desk.wait_for(lambda: shown.input_value() == "far.json", "the list to show it")
    desk.page.get_by_text(str(tmp_path / "far.json")).first.wait_for()
    desk.enter(field, "pilars")
    desk.refusal("There is no file pilars").wait_for()
    assert shown.input_value() == "far.json"
    before = desk.session.source
    desk.page.get_by_role("button", name="Open", exact=True).click()
    desk.wait_for(lambda: desk.session.source is not before, "the world again")
    choose(desk, "pillars")
    desk.wait_for(lambda: desk.session.frame.source.name.startswith("pillars"), "the room")
    desk.wait_for(lambda: shown.input_value() == "pillars", "the list to show it")
    assert not desk.session.playing
    assert desk.console == [] and desk.dashboard.failures == 0


def test_open_lies_below_all_that_it_uses(restored_desk):
    def top(label: str) -> float:
        box = restored_desk.control(label).bounding_box()
        assert box is not None
        return box["y"]

    button = restored_desk.page.get_by_role("button", name="Open", exact=True).bounding_box()
    assert button is not None
    assert max(map(top, ("Seed", "Scene", "Obstacles", "LiDAR"))) < button["y"] < top("Path")


def test_a_seed_typed_just_before_the_click_counts(restored_desk):
    desk = restored_desk
    desk.choose("Scene", "forest")  # a test before may have chosen another one
    for seed in (17, 23, 0):
        desk.type_number(desk.control("Seed").locator("input"), seed)
        desk.page.get_by_role("button", name="Open", exact=True).click()
        desk.wait_for(lambda: desk.session.frame.source.name == f"forest-100-{seed}", f"forest {seed}")  # noqa: B023


def test_a_source_that_is_opened_after_a_flight_has_ended_plays(restored_desk, tmp_path):
    desk = restored_desk
    World("near", np.array([0.0, 0.0, 2.0]), np.array([0.2, 0.0, 2.0])).save(tmp_path / "near.json")
    desk.control("Path").locator("input").fill(str(tmp_path / "near.json"))
    desk.click("Open path")
    desk.wait_for(lambda: desk.session.frame.source.name == "near", "the world")
    assert not desk.session.playing, "the one before stood, too"
    desk.click("Play")
    desk.wait_for(lambda: desk.session.frame.outcome == "arrived" and not desk.session.playing, "the end")
    choose(desk, "forest")
    desk.wait_for(lambda: desk.session.frame.source.name.startswith("forest"), "the forest")
    desk.wait_for(lambda: desk.session.playing, "the flight to start")


def test_a_scene_is_opened_with_the_obstacles_lidar_noise_and_wind_of_the_page(fresh_desk):
    desk = fresh_desk
    obstacles = desk.control("Obstacles").locator("input")
    assert obstacles.input_value() == "100", "the forest's own"
    desk.type_number(desk.control("Obstacles").locator("input"), 40)
    desk.choose("LiDAR", "spinning64")
    desk.open_folder("Noise and wind", "Gust speed w [m/s]")
    desk.type_number(desk.control("Position error [m]").locator("input"), 0.05)
    desk.type_number(desk.control("Gust speed w [m/s]").locator("input"), 2)
    desk.page.get_by_role("button", name="Open", exact=True).click()
    desk.refusal("set drone.drag too").wait_for()
    assert desk.session.frame.source.name == "forest-100-0"
    desk.type_number(desk.control("Drag k [1/s]").locator("input"), 0.3)
    desk.page.get_by_role("button", name="Open", exact=True).click()
    desk.wait_for(lambda: desk.session.frame.source.name == "forest-40-0", "a forest of 40 trees")
    settings = desk.session.frame.source.settings
    assert settings["lidar"]["name"] == "spinning64"
    assert settings["noise"]["position"] == 0.05
    assert (settings["drone"]["drag"], settings["drone"]["gust_speed"]) == (0.3, 2.0)
    desk.wait_for(
        lambda: desk.session.config.unseen_space.view == "-22.5 22.5", "the planner to know the field of view"
    )
    assert obstacles.input_value() == "40"
    choose(desk, "wall")
    desk.wait_for(lambda: desk.session.frame.source.name.startswith("wall"), "the wall")
    desk.wait_for(obstacles.is_disabled, "a scene without a choice of obstacles")
