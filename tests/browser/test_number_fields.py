"""Numbers count on Enter or when their field is left."""

import pytest

from aero_viz.session.config_history import DRAG_INTERVAL

SPEED = "vehicle.speed_limit"


@pytest.fixture
def tune(restored_desk):
    restored_desk.open_tab("Tune")
    restored_desk.parameter(SPEED).wait_for()
    return restored_desk


def test_a_number_that_is_typed_slowly_counts_as_a_whole_and_is_one_step_of_undo(tune):
    desk, session = tune, tune.session
    number = desk.parameter(SPEED).locator("input")
    session.configure({SPEED: 7.0})
    desk.wait_for(lambda: number.input_value() == "7", "the speed limit")
    seen = []
    sink = session.subscribe(lambda frame: seen.append(frame.config.vehicle.speed_limit), every=True, name="test")
    session.play()
    for text, old, end in (("12", "7", "Enter"), ("45", "12", "Tab")):
        number.click(click_count=3)
        for letter in text:
            number.press(letter)
            desk.page.wait_for_timeout(400)
        assert session.config.vehicle.speed_limit == float(old), "nothing before the end"
        number.press(end)
        desk.wait_for(lambda: session.config.vehicle.speed_limit == float(text), f"{text} m/s")  # noqa: B023
        assert number.input_value() == text
        desk.page.wait_for_timeout(1e3 * DRAG_INTERVAL + 100)  # within it, both would be one step of undo
    session.pause()
    desk.wait_for(lambda: 45.0 in seen, "a plan with the last number")
    session.unsubscribe(sink)
    assert set(seen) == {7.0, 12.0, 45.0}
    desk.click("undo")
    desk.wait_for(lambda: session.config.vehicle.speed_limit == 12.0, "one step back")


@pytest.mark.parametrize(("text", "words"), [("", "The field was empty: 7 stays."), ("-", "- is no number: 7 stays.")])
def test_an_empty_field_shows_its_number_again_and_says_why(tune, text: str, words: str):
    desk, session = tune, tune.session
    session.configure({SPEED: 7.0})
    number = desk.parameter(SPEED).locator("input")
    desk.wait_for(lambda: number.input_value() == "7", "the speed limit")
    number.click(click_count=3)
    number.press("Backspace")
    if text:
        number.press(text)
    number.press("Tab")
    desk.page.get_by_text(words).wait_for()
    assert number.input_value() == "7" and session.config.vehicle.speed_limit == 7.0


def test_a_refused_number_gives_way_to_the_one_before_and_the_page_says_why(tune):
    desk, session = tune, tune.session
    session.configure({SPEED: 50.0})
    number = desk.parameter(SPEED).locator("input")
    desk.wait_for(lambda: number.input_value() == "50", "the speed limit")
    number.click(click_count=3)
    for letter in "75":
        number.press(letter)
        desk.page.wait_for_timeout(400)
    number.press("Enter")
    desk.page.get_by_text("Refused: ").wait_for()
    desk.wait_for(lambda: number.input_value() == "50", "the number before")
    number.fill("9")
    number.press("Escape")
    assert number.input_value() == "50"
    number.press("Tab")
    desk.page.wait_for_timeout(300)
    assert session.config.vehicle.speed_limit == 50.0


def test_one_drag_is_one_event_and_one_step_of_undo(tune):
    desk, session = tune, tune.session
    session.configure({SPEED: 7.0})
    desk.wait_for(lambda: session.frame.config.vehicle.speed_limit == 7.0, "the speed limit")
    session.step(1).result()
    thumb = desk.slider(SPEED).get_by_role("slider")
    thumb.scroll_into_view_if_needed()
    box = thumb.bounding_box()
    before = [event for event in desk.dashboard.history.past().events if event.kind == "parameters"]
    session.play()
    desk.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), (40.0, 0.0))
    desk.wait_for(lambda: session.config.vehicle.speed_limit > 8.0, "another speed limit")
    time = session.frame.time
    desk.wait_for(lambda: session.frame.time > time, "a plan with it")
    session.pause()
    desk.page.wait_for_timeout(300)
    events = [event for event in desk.dashboard.history.past().events if event.kind == "parameters"]
    (event,) = events[len(before) :]
    assert "7 → " in event.text and event.text.endswith(f"{session.config.vehicle.speed_limit:g}")
    desk.click("undo")
    desk.wait_for(lambda: session.config.vehicle.speed_limit == 7.0, "all of it undone")
