"""Playing, tuning, sources and clients, through the page."""

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.dashboard import palette
from tests.browser.desk import COARSE, visit
from tests.browser.pictures import Image, count, differing


def status_text(desk) -> str:
    return desk.page.locator("body").inner_text()


def test_the_page_connects_and_shows_the_plan(desk):
    desk.wait_for(lambda: "shorter is better" in status_text(desk), "the planner's panel")
    text = status_text(desk)
    assert "forest" in text
    assert "paused" in text
    assert desk.page.locator("canvas").count() >= 1


def test_dragging_a_slider_changes_the_configuration_and_the_picture(desk):
    desk.dashboard.show_only(["rollouts"])
    position = np.asarray(desk.session.frame.observation.state.position)

    def render() -> Image:
        return desk.render(np.add(position, (-3.0, 0.0, 2.0)), position)

    desk.wait_for(lambda: count(render(), palette.CHOSEN) > 60, "the rollouts")
    before = render()
    value, version = desk.session.config.costs.q_track, desk.session.frame.config_version
    desk.open_tab("Tune")
    track = desk.slider("costs.q_track").locator(".mantine-Slider-trackContainer")
    track.scroll_into_view_if_needed()
    box = track.bounding_box()
    desk.page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + box["height"] / 2)
    desk.page.mouse.down()
    desk.page.mouse.move(box["x"] + 0.1 * box["width"], box["y"] + box["height"] / 2, steps=4)
    desk.page.mouse.up()
    desk.wait_for(lambda: desk.session.config.costs.q_track < 0.5 * value, "the new weight")
    desk.wait_for(lambda: desk.session.frame.config == desk.session.config, "a plan with the new weight")
    assert desk.session.frame.config_version > version
    desk.wait_for(lambda: differing(render(), before) > 200, "other rollouts")
    desk.page.get_by_role("button", name="undo").click()
    desk.wait_for(lambda: desk.session.config.costs.q_track == value, "the weight before")


def test_a_typed_value_beyond_the_end_of_the_slider_is_accepted_unchanged(desk):
    desk.open_tab("Tune")
    before = desk.session.config.costs.q_position
    number = desk.parameter("costs.q_position").locator("input")
    for value in ("30", "3.75"):
        number.fill(value)
        number.blur()
        desk.wait_for(lambda: desk.session.config.costs.q_position == float(value), f"a weight of {value}")  # noqa: B023
        desk.page.wait_for_timeout(300)
        assert number.input_value() == value and desk.session.config.costs.q_position == float(value)
    number.fill("2000")
    number.blur()
    desk.refusal("must be a number in [0, 1000]").first.wait_for()
    desk.wait_for(lambda: 0.0 < float(number.input_value()) <= 1000.0, "a valid weight")
    assert desk.session.config.costs.q_position == float(number.input_value())
    desk.session.configure({"costs.q_position": before})
    desk.wait_for(lambda: float(number.input_value()) == before, "the weight before")


def test_a_logarithmic_slider_shows_values_and_sets_them(desk):
    desk.open_tab("Tune")
    desk.choose("Show", "expert")
    desk.open_folder("Noise and weights", "Temperature lambda")
    slider, before = desk.slider("sampling.temperature"), desk.session.config.sampling.temperature
    labels = slider.locator(".mantine-Slider-markLabel").all_inner_texts()
    assert labels == ["0.001", "0.01", "0.1", "1", "10", "100", "1000"]
    slider.locator(".mantine-Slider-trackContainer").click()  # at its centre
    desk.wait_for(lambda: desk.session.config.sampling.temperature == pytest.approx(1.0, rel=0.1), "a temperature of 1")
    number = desk.parameter("sampling.temperature").locator("input")
    desk.wait_for(lambda: float(number.input_value()) == desk.session.config.sampling.temperature, "the same number")
    desk.click("undo")
    desk.wait_for(lambda: float(number.input_value()) == before, "the temperature before")
    desk.choose("Show", "basic")


def test_the_step_pause_restart_and_time_controls_work(restored_desk):
    desk = restored_desk
    desk.dashboard.show_only(["rollouts", "drone"])  # quick to draw
    index = desk.session.frame.index
    desk.click("+10")
    desk.wait_for(lambda: desk.session.frame.index == index + 10, "ten ticks")
    desk.click("-1")
    desk.wait_for(lambda: desk.session.frame.index == index + 9, "one tick back")
    flown = desk.session.frame.plan.positions.copy()
    desk.click("+1")
    desk.wait_for(lambda: desk.session.frame.index == index + 10, "one tick forward")
    desk.click("-1")
    desk.wait_for(lambda: desk.session.frame.index == index + 9, "the same tick again")
    np.testing.assert_array_equal(desk.session.frame.plan.positions, flown)

    desk.click("Play")
    desk.wait_for(lambda: desk.session.frame.index > index + 15, "time to advance")
    desk.click("Pause")
    desk.wait_for(lambda: not desk.session.playing, "the pause")
    stopped = desk.session.frame.index
    desk.page.wait_for_timeout(300)
    assert desk.session.frame.index == stopped

    desk.click("Restart")
    desk.wait_for(lambda: desk.session.frame.time == 0.0, "the beginning")
    assert not desk.session.playing
    desk.session.seek(desk.session.time_range[1]).result()
    assert desk.session.frame.index == stopped

    row = desk.control("Time [s]")
    box = row.locator(".mantine-Slider-trackContainer").bounding_box()
    desk.page.mouse.click(box["x"] + 0.3 * box["width"], box["y"] + box["height"] / 2)
    desk.wait_for(lambda: desk.session.frame.index < stopped - 3, "an earlier tick")
    entry = row.locator("input").last
    desk.enter(entry, "100")  # beyond the last tick flown: the slider then shows the time that was reached
    desk.wait_for(lambda: abs(float(entry.input_value()) - desk.session.frame.time) < 0.02, "the time reached")
    assert desk.console == []


def test_the_page_follows_play_pause_and_steps_from_elsewhere(restored_desk):
    desk = restored_desk
    desk.dashboard.show_only(["drone"])
    desk.session.play()
    desk.page.get_by_role("button", name="Pause", exact=True).wait_for()
    desk.session.pause()
    desk.page.get_by_role("button", name="Play", exact=True).wait_for()
    desk.wait_for(lambda: "paused" in status_text(desk), "the status")
    desk.session.step(3).result()
    time = f"{desk.session.frame.time:.2f} s"
    desk.wait_for(lambda: time in status_text(desk), "the panels to follow a step from elsewhere")


def test_a_wrong_path_is_reported_and_the_source_stays(restored_desk):
    desk = restored_desk
    source = desk.session.source
    desk.control("Path").locator("input").fill("/nowhere/at-all.mcap")
    desk.click("Open path")
    desk.page.get_by_text("/nowhere/at-all.mcap").last.wait_for()
    desk.wait_for(lambda: "Error" in status_text(desk), "a notification")
    assert desk.session.source is source
    index = desk.session.frame.index
    desk.click("+1")
    desk.wait_for(lambda: desk.session.frame.index == index + 1, "the old source to continue")

    desk.click("Open")
    desk.wait_for(lambda: desk.session.source is not source, "the source on offer")
    desk.wait_for(lambda: desk.session.source.name in status_text(desk), "its name")
    desk.wait_for(lambda: desk.session.config == desk.known(PlannerConfig()), "the facts of its flight")


def test_a_second_client_can_leave_during_a_flight_without_affecting_the_first(restored_desk, browser):
    desk = restored_desk
    desk.dashboard.show_only(["rollouts", "drone"])
    desk.session.set_speed(0.2)  # so that the flight still goes on when the second client has left
    second = visit(browser, desk.dashboard.url, resolution=COARSE)
    desk.wait_for(lambda: len(desk.dashboard.server.get_clients()) == 2, "the second client")
    desk.click("Play")
    second.get_by_role("button", name="Pause", exact=True).wait_for()
    second.close()
    index = desk.session.frame.index
    desk.wait_for(lambda: len(desk.dashboard.server.get_clients()) == 1, "the second client to be gone")
    desk.session.set_speed(1.0)
    desk.wait_for(lambda: desk.session.frame.index > index + 20, "the flight to continue")
    desk.dashboard.update_ms.clear()
    desk.wait_for(lambda: len(desk.dashboard.update_ms) > 5, "updates for the one that stayed")
    desk.click("Pause")
    assert desk.console == []
    assert desk.dashboard.failures == 0


@pytest.mark.parametrize("camera", ["top", "side", "follow"])
def test_a_camera_button_moves_the_camera_to_its_view(desk, camera):
    desk.click(camera)
    drone = np.asarray(desk.session.frame.observation.state.position)

    def is_in_view() -> bool:
        x, y, z = np.asarray(desk.camera.position) - drone
        return {"top": z > 15.0, "side": abs(y) > 6.0, "follow": x < -3.0 and z < 4.0}[camera]

    desk.wait_for(is_in_view, camera)


def test_a_free_camera_stays_where_it_is(desk):
    desk.click("top")
    drone = np.asarray(desk.session.frame.observation.state.position)
    desk.wait_for(lambda: desk.camera.position[2] - drone[2] > 15.0, "top")
    desk.click("free")
    for _ in range(5):
        desk.page.wait_for_timeout(100)
        assert desk.dashboard.drain()
    assert desk.camera.position[2] - drone[2] > 15.0


def test_the_console_shows_no_errors(desk):
    assert desk.console == []
