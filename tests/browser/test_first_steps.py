"""The first steps of docs/page.md, on the page alone."""

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source
from tests.browser.desk import COARSE, Desk, open_desk

SCENE = "double_wall_trap"


def fly(desk: Desk) -> str:
    """Press Play and wait for the end of the flight; return its outcome."""
    desk.click("Play")
    return end_of_flight(desk)


def end_of_flight(desk: Desk) -> str:
    """Wait as long as the flight goes on, however slowly; return its outcome."""
    frame = desk.session.frame
    while frame is None or frame.outcome is None or frame.source is not desk.session.source:
        desk.wait_for(lambda: desk.session.frame is not frame, "the next tick")  # noqa: B023
        frame = desk.session.frame
    return frame.outcome


def test_a_newcomer_finds_why_a_flight_fails_changes_it_checks_keeps_and_sends_it(browser, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    source, paper = open_source(SCENE, seed=1), PlannerConfig.preset("paper")
    with open_desk(browser, source, ticks=1, config=paper, resolution=COARSE, layers=["drone"], opened=SCENE) as desk:
        desk.session.set_speed(10.0)  # of time on the page; the flight is the same
        assert fly(desk) == "collision"
        desk.open_tab("Why")
        report = desk.page.locator(".aero-report")
        report.wait_for()
        assert "It hit the ground" in report.inner_text()
        assert "in the frame of the sensor, which sees -7 to 52 deg" in report.inner_text()

        desk.open_tab("Tune")
        preset = desk.control("Preset").locator("input").first
        desk.choose("Preset", "default")
        desk.wait_for(lambda: desk.session.config.stop_proof.prove_stop, "the default configuration")
        desk.click("Restart")
        desk.wait_for(
            lambda: desk.session.playing and (now := desk.session.frame) is not None and now.outcome is None,
            "the flight again",
        )
        assert end_of_flight(desk) == "arrived"

        for seed in (2, 3):
            desk.open_tab("Fly")
            number = desk.control("Seed").locator("input")
            desk.enter(number, seed)
            before = desk.session.source
            desk.click("Open")
            desk.wait_for(lambda: desk.session.source is not before, "another seed")  # noqa: B023
            assert end_of_flight(desk) == "arrived"

        desk.open_tab("Tune")
        desk.open_folder("Save as a preset", "Save preset")
        name = desk.control("Name").locator("input")
        desk.enter(name, "room")
        desk.wait_for(lambda: preset.input_value() == "room", "the saved preset")
        assert list((tmp_path / "config").rglob("room.yaml"))

        desk.open_tab("Fly")
        desk.open_folder("Share", "Log")
        path = desk.download("Log", tmp_path)
        assert path.suffix == ".mcap" and SCENE in path.name
        assert desk.console == []
