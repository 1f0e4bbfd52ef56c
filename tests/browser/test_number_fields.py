"""Numbers count on Enter or when their field is left: what a person types, and what is flown."""

import numpy as np
import pytest

from aero_viz.session.config_history import DRAG_INTERVAL
from tests.browser.desk import Desk

SPEED = "vehicle.speed_limit"


@pytest.fixture
def tune(restored_desk: Desk) -> Desk:
    """A page with the parameters, at 7 m/s."""
    desk = restored_desk
    desk.open_tab("Tune")
    desk.session.configure({SPEED: 7.0})
    desk.wait_for(lambda: speed_field(desk).input_value() == "7", "the speed limit")
    return desk


def speed_field(desk: Desk):
    return desk.parameter(SPEED).locator("input")


def speed(desk: Desk) -> float:
    return desk.session.config.vehicle.speed_limit


def type_slowly(desk: Desk, field, text: str, *, pause: int = 250) -> None:
    """Replace what a field holds, one key after another."""
    field.click(click_count=3)
    for letter in text:
        field.press(letter)
        desk.page.wait_for_timeout(pause)


def test_a_number_that_is_typed_slowly_counts_as_a_whole_and_is_one_step_of_undo(tune):
    desk, session, seen = tune, tune.session, []
    sink = session.subscribe(lambda frame: seen.append(frame.config.vehicle.speed_limit), every=True, name="test")
    session.play()
    for text, old, end in (("12", 7.0, "Enter"), ("0.35", 12.0, "Tab"), ("45.5", 0.35, "Enter")):
        type_slowly(desk, speed_field(desk), text)
        assert speed(desk) == old, "nothing before the end"
        desk.page.keyboard.press(end)
        desk.wait_for(lambda: speed(desk) == float(text), f"{text} m/s")  # noqa: B023
        assert speed_field(desk).input_value() == text
        desk.page.wait_for_timeout(1e3 * DRAG_INTERVAL + 100)  # within it, both would be one step of undo
    session.pause()
    desk.wait_for(lambda: 45.5 in seen, "a plan with the last number")
    session.unsubscribe(sink)
    assert set(seen) == {7.0, 12.0, 0.35, 45.5}
    for old in (0.35, 12.0, 7.0):
        desk.click("undo")
        desk.wait_for(lambda: speed(desk) == old, "one step back")  # noqa: B023


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the field was empty, so 7 stays."),
        ("-", "'-' is not a number in digits, such as -1.5, so 7 stays."),
        ("1e3", "'1e..' is not a number in digits, such as -1.5, so 7 stays."),
        ("0,4", "'0,..' is not a number in digits, such as -1.5, so 7 stays."),
    ],
)
@pytest.mark.parametrize("end", ["Enter", "Tab"])
def test_what_is_no_number_gives_way_to_the_one_before_and_the_page_says_why(tune, text: str, words: str, end: str):
    desk, field = tune, speed_field(tune)
    field.click(click_count=3)
    field.press("Backspace")
    field.press_sequentially(text, delay=80)
    field.press(end)
    desk.page.get_by_text(words).wait_for()
    desk.wait_for(lambda: field.input_value() == "7", "the number before")
    assert speed(desk) == 7.0
    type_slowly(desk, field, "8.25", pause=20)
    field.press(end)
    desk.wait_for(lambda: speed(desk) == 8.25, "the next number")


def test_a_refused_number_gives_way_to_the_one_before_and_the_page_says_why(tune):
    desk, field = tune, speed_field(tune)
    desk.session.configure({SPEED: 50.0})
    desk.wait_for(lambda: field.input_value() == "50", "the speed limit")
    for _ in range(2):  # the same again
        type_slowly(desk, field, "75")
        field.press("Enter")
        desk.page.get_by_text("Refused: ").wait_for()
        desk.wait_for(lambda: field.input_value() == "50", "the number before")
    assert speed(desk) == 50.0


def test_escape_brings_the_number_back(tune):
    desk, field = tune, speed_field(tune)
    type_slowly(desk, field, "9.5")
    field.press("Escape")
    assert field.input_value() == "7"
    field.press("Tab")
    desk.page.wait_for_timeout(300)
    assert speed(desk) == 7.0
    assert desk.page.locator(".mantine-Notification-root").count() == 0, "that was asked for"


def test_a_number_that_is_typed_quickly_counts_before_the_click_that_follows(tune):
    desk, session = tune, tune.session
    samples = session.config.sampling.samples
    desk.choose("Show", "expert")
    field = desk.parameter("sampling.samples").locator("input")
    for count in (48, 64, samples):
        field.click(click_count=3)
        field.press_sequentially(str(count))
        desk.click("Apply")
        desk.wait_for(lambda: session.config.sampling.samples == count, f"{count} samples")  # noqa: B023
    field.click(click_count=3)
    field.press_sequentially("1.5")
    field.press("Enter")
    desk.page.get_by_text(f"'1...' is not a number in digits, such as -1.5, so {samples} stays.").wait_for()
    assert field.input_value() == str(samples), "not 15"
    desk.choose("Show", "basic")


def test_a_number_that_is_pasted_counts_as_it_was_written(tune):
    desk, field = tune, speed_field(tune)
    for text, value in (("1e1", 10.0), ("3.123456789123", 3.123456789)):
        field.fill(text)
        field.press("Enter")
        desk.wait_for(lambda: speed(desk) == value, text)  # noqa: B023
        desk.wait_for(lambda: float(field.input_value()) == value, "the number in digits")  # noqa: B023


def test_arrows_and_sliders_count_at_once_also_after_typing(tune):
    desk, field = tune, speed_field(tune)
    type_slowly(desk, field, "9")
    field.press("ArrowUp")
    desk.wait_for(lambda: speed(desk) > 9.0, "a step up")
    assert float(field.input_value()) == speed(desk)
    type_slowly(desk, field, "8")
    thumb = desk.slider(SPEED).get_by_role("slider")
    thumb.scroll_into_view_if_needed()
    box = thumb.bounding_box()
    desk.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), (40.0, 0.0))
    desk.wait_for(lambda: speed(desk) > 9.0, "the slider's value")
    desk.wait_for(lambda: float(field.input_value()) == speed(desk), "the field to follow")


def test_a_component_of_the_goal_counts_as_a_whole_and_leaves_the_others(restored_desk):
    desk = restored_desk
    desk.session.set_goal((10.0, 0.5, 2.0)).result()
    fields = desk.control("Goal [m]").locator("input")
    desk.wait_for(lambda: [box.input_value() for box in fields.all()] == ["10", "0.5", "2"], "the goal in numbers")
    goals = []
    sink = desk.session.subscribe(
        lambda frame: goals.append(tuple(frame.observation.goal.position)), every=True, name="t"
    )
    type_slowly(desk, fields.nth(1), "-1.25")
    fields.nth(1).press("Tab")
    desk.wait_for(lambda: bool(goals) and goals[-1] == (10.0, -1.25, 2.0), "the goal")
    desk.session.unsubscribe(sink)
    fields.nth(1).fill("")
    fields.nth(1).press("Enter")
    desk.page.get_by_text("Goal [m]: the field was empty, so -1.25 stays.").wait_for()
    assert fields.nth(1).input_value() == "-1.25"
    assert set(goals) <= {(10.0, 0.5, 2.0), (10.0, -1.25, 2.0)}


def test_the_time_can_be_typed_while_it_runs(restored_desk):
    desk = restored_desk
    desk.session.set_speed(0.25)
    desk.session.play()
    desk.wait_for(lambda: desk.session.frame.time > 0.5, "half a second")
    field = desk.control("Time [s]").locator("input").last
    field.click()
    desk.page.wait_for_timeout(500)  # an update that was on its way would end a selection, which takes a person longer
    type_slowly(desk, field, "0.24", pause=400)
    desk.wait_for(lambda: field.input_value() == "0.24", "what was typed, not the time that runs")
    assert desk.session.playing
    field.press("Enter")
    desk.wait_for(lambda: not desk.session.playing and np.isclose(desk.session.frame.time, 0.24), "the time")
    type_slowly(desk, field, "99", pause=20)
    field.press("Enter")
    desk.page.get_by_text("Time [s]: 99 is more than").wait_for()
    desk.wait_for(lambda: float(field.input_value()) == 0.24, "the time before")
