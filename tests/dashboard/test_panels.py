"""Controls and texts of the panels, without a browser."""

import math

import pytest
import viser

from aero_planner import PlannerConfig
from aero_planner.config.file import format_config
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.dashboard.layers import apply
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.conditions import ConditionControls
from aero_viz.dashboard.panels.configuration import parse_upload
from aero_viz.dashboard.panels.controls import ItemsControl, SliderControl, add_control
from aero_viz.dashboard.panels.parameter_row import ParameterRow
from aero_viz.dashboard.panels.study import progress
from aero_viz.dashboard.server import LocalServer
from aero_viz.dashboard.viser_private import inputs
from aero_viz.scenes import SCENES
from aero_viz.session.source import Conditions
from aero_viz.study_view import StudyView


@pytest.mark.parametrize("preset", PlannerConfig.presets())
def test_every_parameter_has_a_control_that_shows_its_value(server, preset):
    config = PlannerConfig.preset(preset)
    for info in PlannerConfig.parameters():
        control = add_control(server.gui, info, info.default)
        apply(control.show(config.get(info.path)))
        value, shown = config.get(info.path), control.value
        assert shown == value, f"{info.path} is {value} and shows {shown}"
        info.check(shown)
        if isinstance(control, SliderControl):
            assert math.isclose(control.slider_value, float(value), rel_tol=0.02)
        assert control.show(value) == [], "nothing is left to change"


def slider(server: LocalServer, path: str) -> SliderControl:
    info = PlannerConfig.find(path)
    control = add_control(server.gui, info, info.default)
    assert isinstance(control, SliderControl)
    return control


def test_a_slider_grows_to_a_value_beyond_its_end(server):
    control = slider(server, "costs.penalty")
    before = control.slider.max
    apply(control.show(1e6))
    assert before < 1e6 <= control.slider.max <= control.info.high
    assert control.value == control.slider.value == 1e6


@pytest.mark.parametrize("path", ["costs.height_min", "costs.height_max"])
def test_a_height_has_a_field_without_a_slider(server, path):
    info = PlannerConfig.find(path)
    control = add_control(server.gui, info, info.default)
    apply(control.show(2.5))
    assert control.value == 2.5 and not isinstance(control, SliderControl)


@pytest.mark.parametrize(
    ("query", "path"),
    [
        ("Q_p", "costs.q_position"),
        ("--way-out.q-escape", "way_out.q_escape"),
        ("way_out.q_escape", "way_out.q_escape"),
        ("braking distance factor", "candidates.brake_reach"),
    ],
)
def test_words_of_the_search_are_matched_whole(server, query, path):
    def ignore(*_: object) -> None:
        pass

    paths = [
        info.path
        for info in PlannerConfig.parameters()
        if ParameterRow(server.gui, info, info.default, on_change=ignore, on_reset=ignore).matches(query)
    ]
    assert paths == [path]


def test_the_stages_have_a_check_box_each_and_the_model_a_menu(server):
    info = PlannerConfig.find("stages.active")
    control = add_control(server.gui, info, info.default)
    assert isinstance(control, ItemsControl) and control.value == info.default
    assert [box.label for box in control.boxes.values()][:2] == ["Unseen space", "Way out"]
    control.boxes["way_out"].value = False
    less = PlannerConfig().replace({"stages.active": control.value})
    assert "way_out" not in less.stages.names and len(less.stages.names) == len(info.items or ()) - 1
    assert not control.show(less.stages.active)
    apply(control.show(""))
    assert control.value == "" and not any(box.value for box in control.boxes.values())
    assert [control.describe(value) for value in ("", "way_out, memory", info.default)] == [
        "none", "way out, memory", "all",
    ]  # fmt: skip
    model = PlannerConfig.find("vehicle.model")
    (menu,) = add_control(server.gui, model, model.default).handles
    assert {"ctbr", "acceleration"} <= set(menu.options)


def test_a_logarithmic_slider_stays_within_the_bounds_of_the_parameter(server):
    control = slider(server, "sampling.temperature")
    for end in (control.slider.min, control.slider.max):
        control.slider.value = end
        control.info.check(control.slider_value)


def test_a_number_field_is_labelled_for_people_and_shows_the_value_itself(server):
    control = slider(server, "sampling.temperature")
    assert control.number.label == "Temperature lambda" and control.number.value == 30.0


def test_an_uploaded_file_is_read_and_a_bad_one_is_named():
    config = PlannerConfig.preset("paper")
    assert parse_upload(viser.UploadedFile("mine.yaml", format_config(config).encode())) == (config, OnboardConfig())
    with pytest.raises(ValueError, match=r"^mine\.yaml.*q_trak"):
        parse_upload(viser.UploadedFile("../../mine.yaml", b"costs:\n  q_trak: 3\n"))


def test_names_from_outside_are_escaped_in_markup():
    assert "<script>" not in markup.block(markup.pill("<script>", (1, 2, 3)), markup.heading("<script>", "<script>"))


def test_the_number_of_obstacles_is_that_of_each_scene_and_a_wrong_one_is_refused(server):
    controls = ConditionControls(server.gui, Conditions())
    count = next(c for c in inputs(server.gui).values() if c.label == "Obstacles")
    for name, kind in SCENES.items():
        controls.offer(name)
        assert count.disabled != kind.counted
        assert (count.value > 0) == kind.counted
        assert controls.read(name).count is None, "the scene's own number"
    for wrong in (-1, 20_001):
        controls.offer("forest")
        count.value = wrong
        with pytest.raises(ValueError, match=f"obstacles is {wrong}; it must be"):
            controls.read("forest")


@pytest.mark.parametrize(
    ("finished", "flights", "text"),
    [
        (0, 0, "no flight has ended yet, 8 candidates to fly"),
        (0, 2, "0 of 8 candidates, 2 flights"),
        (3, 8, "3 of 8 candidates, 8 flights"),
    ],
)
def test_a_study_says_how_far_it_is(finished: int, flights: int, text: str):
    assert progress(StudyView("poles", finished, 8, flights, 0.0, (), (), ())) == text
