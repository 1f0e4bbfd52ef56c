"""Files, presets and structure of the configuration, through the page."""

from pathlib import Path

import pytest

from aero_planner import PlannerConfig
from aero_planner.config.file import format_config, load_config
from aero_planner.onboard.flight_config import load_flight_config
from tests.browser.desk import COARSE, Desk, visit

DEFAULT = PlannerConfig()


def upload(desk: Desk, path: Path) -> None:
    desk.open_folder("File", "Upload YAML")
    with desk.page.expect_file_chooser() as chooser:
        desk.click("Upload YAML")
    chooser.value.set_files(path)


def test_a_downloaded_file_restores_its_configuration_when_uploaded(restored_desk, tmp_path):
    desk = restored_desk
    saved = desk.session.configure({"costs.q_track": 7.5, "candidates.previous": False})
    desk.open_tab("Tune")
    desk.open_folder("File", "Download YAML")
    path = desk.download("Download YAML", tmp_path)
    assert path.name == "aero-planner.yaml"
    assert path.read_text() == format_config(saved)
    assert load_config(path) == saved

    desk.click("reset all")
    desk.wait_for(lambda: desk.session.config == desk.known(DEFAULT), "the defaults")
    upload(desk, path)
    desk.wait_for(lambda: desk.session.frame.config == desk.known(saved), "a plan with the configuration of the file")
    field = desk.parameter("costs.q_track").locator("input")
    desk.wait_for(lambda: float(field.input_value()) == 7.5, "the slider to show it")
    assert desk.console == []


def test_onboard_settings_survive_an_upload_and_a_download(fresh_desk, tmp_path):
    desk = fresh_desk
    flight = tmp_path / "flight.yaml"
    flight.write_text("costs:\n  q_track: 7.5\nonboard:\n  thrust:\n    hover_thrust: 0.42\n")
    desk.open_tab("Tune")
    upload(desk, flight)
    desk.wait_for(lambda: desk.session.config.costs.q_track == 7.5, "the configuration of the file")
    desk.session.configure({"costs.q_track": 8.5})
    planner, onboard = load_flight_config(desk.download("Download YAML", tmp_path))
    assert planner.costs.q_track == 8.5 and onboard.thrust.hover_thrust == 0.42


def test_presets_and_resets_set_the_configuration_that_they_name(restored_desk):
    desk = restored_desk
    desk.session.configure(DEFAULT)
    desk.open_tab("Tune")
    preset = desk.control("Preset").locator("input").first
    desk.wait_for(lambda: preset.input_value() == "default", "the default preset to be shown")

    desk.session.configure({"costs.q_track": 7.5, "candidates.previous": False})
    desk.wait_for(lambda: preset.input_value() == "(changed)", "the changes to be seen")
    desk.click("Reset tracking and effort")
    desk.wait_for(lambda: desk.session.config == DEFAULT.replace({"candidates.previous": False}), "the default weights")
    desk.click("reset all")
    desk.wait_for(lambda: desk.session.config == desk.known(DEFAULT), "the default")

    for name in ("fast-cpu", "paper", "default"):
        desk.choose("Preset", name)
        chosen = desk.known(PlannerConfig.preset(name))
        desk.wait_for(lambda: desk.session.config == chosen, name)  # noqa: B023
        desk.wait_for(lambda: preset.input_value() == name, f"{name} to be shown")  # noqa: B023


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("costs: [1, 2", "bad.yaml"),
        ("costs:\n  q_trak: 3\n", "q_trak"),
        ("costs:\n  q_track: -3\n", "q_track"),
        ("onboard:\n  lidr:\n    port: 1\n", "lidr"),
        ("", "sets nothing"),
        (b"\xff\xfe\x00\x81", "bad.yaml"),
    ],
    ids=["no YAML", "unknown name", "out of bounds", "unknown section of the node", "empty", "no text"],
)
def test_a_malformed_file_is_refused_with_a_reason(restored_desk, tmp_path, content, words):
    desk = restored_desk
    before, version = desk.session.config, desk.session.frame.config_version
    path = tmp_path / "bad.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    desk.open_tab("Tune")
    upload(desk, path)
    notice = desk.refusal(words)
    notice.wait_for()
    assert desk.session.config == before
    assert desk.session.frame.config_version == version
    desk.dismiss(notice)


def test_applying_the_structure_form_rebuilds_the_planner(restored_desk):
    desk = restored_desk
    assert desk.session.frame.plan.stage1_cost.shape[1] == 256
    desk.open_tab("Tune")
    desk.open_folder("Structure", "Samples K")
    number = desk.parameter("sampling.samples").locator("input")
    desk.enter(number, "64")
    desk.page.wait_for_timeout(300)
    assert desk.session.config.sampling.samples == 256, "a form acts when it is applied"
    desk.click("Apply")
    desk.wait_for(lambda: desk.session.config.sampling.samples == 64, "the new structure")
    desk.wait_for(lambda: desk.session.frame.plan.stage1_cost.shape[1] == 64, "a plan with 64 samples")
    index = desk.session.frame.index
    desk.click("+1")
    desk.wait_for(lambda: desk.session.frame.index == index + 1, "the flight to continue")
    desk.click("undo")
    desk.wait_for(lambda: desk.session.frame.plan.stage1_cost.shape[1] == 256, "the structure before")
    desk.wait_for(lambda: number.input_value() == "256", "the form to show it")
    assert desk.console == []
    assert desk.dashboard.failures == 0


@pytest.mark.parametrize("way", ["click", "Enter"])
def test_a_structural_number_typed_just_before_apply_is_used(restored_desk, way):
    desk = restored_desk
    desk.open_tab("Tune")
    desk.open_folder("Structure", "Samples K")
    number = desk.parameter("sampling.samples").locator("input")
    for samples in (64, 96):
        desk.type_number(number, samples)
        if way == "Enter":
            number.press("Enter")
            desk.page.wait_for_timeout(100)
        desk.click("Apply")
        desk.wait_for(lambda: desk.session.config.sampling.samples != 256, "another structure")
        desk.wait_for(lambda: desk.session.config.sampling.samples == samples, f"{samples} samples")  # noqa: B023


def test_the_upload_of_a_file_is_shown_on_the_page_of_the_upload_only(restored_desk, browser, tmp_path):
    desk = restored_desk
    path = tmp_path / "mine.yaml"
    path.write_text("costs:\n  q_track: 7.5\n")
    with visit(browser, desk.dashboard.url, resolution=COARSE) as early:
        desk.wait_for(lambda: len(desk.dashboard.server.get_clients()) == 2, "another visitor")
        desk.open_tab("Tune")
        upload(desk, path)
        desk.wait_for(lambda: desk.session.config.costs.q_track == 7.5, "the configuration of the file")
        desk.page.get_by_text("File uploaded successfully").wait_for()
        with visit(browser, desk.dashboard.url, resolution=COARSE) as late:
            desk.wait_for(lambda: len(desk.dashboard.server.get_clients()) == 3, "a late visitor")
            for page in (early, late):
                page.get_by_role("tab", name="Tune").wait_for()
                page.wait_for_timeout(500)
                assert page.get_by_text("Uploading").count() == 0
