"""Search, levels, resets, refusals and saved presets of the parameters, through the page."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser
from small_source import small_config, small_source

from aero_planner import PlannerConfig
from aero_viz.dashboard.preset_store import PresetStore
from tests.browser.desk import COARSE, Desk, open_desk

CONFIG = small_config().replace({"sampling.samples": PlannerConfig().sampling.samples})


@contextlib.contextmanager
def preset_folder(path: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(path))
        yield


@contextlib.contextmanager
def open_tune(browser: Browser, presets: Path) -> Iterator[Desk]:
    """Open the tab with the parameters; presets are saved in a folder."""
    with (
        preset_folder(presets),
        open_desk(
            browser, small_source(), ticks=3, size=(1280, 720), config=CONFIG, resolution=COARSE, layers=["drone"]
        ) as desk,
    ):
        desk.open_tab("Tune")
        desk.parameter("costs.q_track").wait_for()
        yield desk
        assert desk.console == [] and desk.dashboard.failures == 0


@pytest.fixture(scope="module")
def page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    with open_tune(browser, tmp_path_factory.mktemp("presets")) as desk:
        yield desk


@pytest.fixture
def tune(page: Desk) -> Desk:
    """A page that tests share, with the parameters as they were at first."""
    page.session.configure(page.known(CONFIG))
    page.choose("Show", "basic")
    page.wait_for(lambda: page.page.locator(".aero-changed").count() == 0, "no changes")
    return page


@pytest.fixture
def tune_alone(browser: Browser, tmp_path: Path) -> Iterator[Desk]:
    """A page without saved presets."""
    with open_tune(browser, tmp_path) as desk:
        yield desk


def is_shown(desk: Desk, path: str) -> bool:
    return desk.parameter(path).count() > 0 and desk.parameter(path).is_visible()


def test_a_search_and_two_levels_narrow_the_parameters(tune):
    desk = tune
    desk.wait_for(lambda: is_shown(desk, "costs.q_position"), "the basic parameters")
    desk.wait_for(lambda: not is_shown(desk, "costs.decay"), "no expert ones")
    desk.choose("Show", "expert")
    desk.wait_for(lambda: is_shown(desk, "costs.decay"), "every parameter")
    desk.choose("Show", "basic")
    desk.control("Search").locator("input").fill("decay rate")
    desk.wait_for(lambda: not is_shown(desk, "costs.q_position"), "others to be hidden")
    desk.wait_for(lambda: is_shown(desk, "costs.decay"), "an expert parameter to be found by its words")
    desk.control("Search").locator("input").fill("q_p")
    desk.wait_for(lambda: is_shown(desk, "costs.q_position"), "a parameter to be found by its symbol")
    desk.control("Search").locator("input").fill("nonsense")
    desk.page.get_by_text("No parameter matches.").wait_for()
    desk.control("Search").locator("input").fill("")
    desk.wait_for(lambda: is_shown(desk, "costs.q_position"), "the basic ones")


def test_what_differs_is_marked_with_its_old_value_and_a_reset(tune):
    desk, session = tune, tune.session
    assert desk.page.locator(".aero-changed").count() == 0
    desk.enter(desk.parameter("costs.q_track").locator("input"), "7.5")
    session.configure({"costs.decay": session.config.costs.decay + 1.0})
    desk.wait_for(lambda: desk.page.locator(".aero-changed").count() == 2, "two marks, one on an expert parameter")
    row = desk.control("was 3.0")
    row.get_by_role("button", name="reset").click()
    desk.wait_for(lambda: session.config.costs.q_track == 3.0, "the value of the preset")
    desk.wait_for(
        lambda: float(desk.parameter("costs.q_track").locator("input").input_value()) == 3.0, "it to be shown"
    )
    desk.wait_for(lambda: desk.page.locator(".aero-changed").count() == 1, "one mark")
    assert session.config.costs.decay != PlannerConfig().costs.decay, "the others stay"
    flags = desk.page.locator(".aero-flags")
    wanted = f"--costs.decay {session.config.costs.decay}"
    desk.wait_for(lambda: flags.inner_text() == wanted, wanted)
    desk.page.get_by_role("button", name="copy yaml").click()
    desk.page.get_by_role("button", name="copied").wait_for()
    assert "decay" in desk.page.evaluate("getSelection().toString()")


def test_a_stage_is_left_out_by_its_box_and_comes_back_by_a_reset(tune):
    desk, session = tune, tune.session
    index, source = session.frame.index, session.frame.source
    desk.choose("Show", "expert")
    desk.checkbox("Memory").click()
    desk.click("Apply")
    desk.wait_for(lambda: "memory" not in session.frame.config.stages.names, "a plan without the stage")
    assert session.frame.index == index and session.frame.source is source, "the flight goes on"
    flags = desk.page.locator(".aero-flags")
    wanted = f"--stages.active '{session.config.stages.active}'"
    desk.wait_for(lambda: flags.inner_text() == wanted, wanted)
    desk.control("was all").get_by_role("button", name="reset").click()
    desk.wait_for(lambda: "memory" in session.frame.config.stages.names, "all stages")
    desk.wait_for(lambda: desk.checkbox("Memory").is_checked(), "the box to show it")
    desk.choose("Show", "basic")


def test_a_refused_value_says_why_in_place_and_the_old_one_stays(tune):
    desk = tune
    number = desk.parameter("costs.distance_min").locator("input")
    desk.enter(number, "1.5")
    reason = desk.page.get_by_text("Refused: costs.distance_min is 1.5")
    reason.wait_for()
    above, field = reason.bounding_box(), number.bounding_box()
    assert above["y"] < field["y"] < above["y"] + 120, "beside its field"
    desk.wait_for(lambda: float(number.input_value()) == PlannerConfig().costs.distance_min, "the old value")
    desk.session.configure({"costs.q_track": 6.0})
    reason.wait_for(state="detached")
    desk.enter(number, "0.2")
    desk.wait_for(lambda: desk.session.config.costs.distance_min == 0.2, "a valid value")
    reason.wait_for(state="detached")


def test_a_preset_is_saved_with_its_goal_and_there_again_tomorrow(tune_alone, browser):
    desk: Any = tune_alone
    goal = np.add(desk.session.frame.observation.goal.position, (0.0, 0.5, 0.25))
    desk.session.set_goal(goal).result()
    saved = desk.session.configure({"costs.q_track": 7.5})
    desk.open_folder("Save as a preset", "Save preset")
    name = desk.control("Name").locator("input")
    for attempt, words in (("../escape", "cannot be the name of a preset"), ("paper", "name of a built-in preset")):
        name.fill(attempt)
        desk.click("Save preset")
        notice = desk.refusal(words)
        notice.wait_for()
        desk.dismiss(notice)
    name.fill("narrow gap")
    desk.click("Save preset")
    preset = desk.control("Preset").locator("input").first
    desk.wait_for(lambda: preset.input_value() == "narrow gap", "it to be the preset")
    assert PresetStore().load("narrow gap").config == saved

    with open_desk(browser, small_source(), ticks=2, size=(1280, 720), resolution=COARSE, layers=["drone"]) as tomorrow:
        session: Any = tomorrow.session
        tomorrow.open_tab("Tune")
        tomorrow.choose("Preset", "narrow gap")
        tomorrow.wait_for(lambda: session.config == tomorrow.known(saved), "its parameters")
        before = tuple(session.frame.observation.goal.position)
        tomorrow.page.get_by_text("was saved with the goal at").wait_for()
        assert tuple(session.frame.observation.goal.position) == before != tuple(goal), "not without an answer"
        tomorrow.click("Move the goal")
        tomorrow.wait_for(lambda: tuple(session.frame.observation.goal.position) == tuple(goal), "its goal")
        (PresetStore().folder / "narrow gap.yaml").write_text("costs:\n  q_trak: 1\n")
        tomorrow.choose("Preset", "paper")
        tomorrow.wait_for(lambda: session.config == tomorrow.known(PlannerConfig.preset("paper")), "another preset")
        tomorrow.choose("Preset", "narrow gap")
        tomorrow.refusal("narrow gap.yaml, line 2").wait_for()
        assert session.config == tomorrow.known(PlannerConfig.preset("paper"))


def test_a_preset_is_deleted_after_a_question(tune):
    desk = tune
    desk.open_folder("Save as a preset", "Save preset")
    name = desk.control("Name").locator("input")
    name.fill("room")
    desk.click("Delete preset")
    desk.refusal("There is no saved preset 'room'").wait_for()
    desk.click("Save preset")
    desk.wait_for(lambda: PresetStore().names() == ["room"], "the preset")
    for answer, names in (("Keep it", ["room"]), ("Delete", [])):
        desk.click("Delete preset")
        desk.page.get_by_text("Delete this preset?").wait_for()
        desk.page.get_by_text(str(PresetStore().path("room"))).wait_for()
        desk.click(answer)
        desk.page.get_by_text("Delete this preset?").wait_for(state="detached")
        desk.wait_for(lambda: PresetStore().names() == names, answer)  # noqa: B023
    desk.page.get_by_text("The preset 'room' was deleted.").wait_for()


def test_play_and_time_stay_in_view_while_the_parameters_scroll(tune):
    desk = tune
    desk.choose("Show", "expert")
    desk.wait_for(lambda: is_shown(desk, "costs.decay"), "every parameter")
    last = desk.page.get_by_role("button", name="Apply", exact=True)

    def is_in_view() -> bool:
        last.scroll_into_view_if_needed()  # again, if more parameters have pushed it out of view
        return last.bounding_box()["y"] < 720

    desk.wait_for(is_in_view, "the last control")
    for control in (desk.page.get_by_role("button", name="Play", exact=True), desk.control("Time [s]")):
        assert 0 < control.bounding_box()["y"] < 300
    tabs = [tab.bounding_box()["y"] for tab in desk.page.locator(".mantine-ScrollArea-content [role=tab]").all()]
    assert max(tabs) - min(tabs) < 5, "one row"
