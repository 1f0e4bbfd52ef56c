"""The Share folder of the page: files of the flight so far, and a link to the present moment."""

import re
import threading
from typing import Any

import imageio.v3 as iio
import numpy as np
from scipy.ndimage import uniform_filter

from aero_planner import PlannerConfig
from aero_viz.dashboard import palette
from aero_viz.dashboard.links import Link
from aero_viz.dashboard.share import FlightFiles
from aero_viz.flight.known_drone import config_for_flight
from tests.browser.desk import LEFT, RIGHT, TIMEOUT, open_desk, quick_forest
from tests.browser.pictures import count, differing


def test_the_flight_so_far_is_downloaded_as_a_page_with_what_was_changed(restored_desk, tmp_path):
    desk = restored_desk
    desk.session.configure({"costs.q_track": 8.0})
    desk.session.step(3).result()
    desk.open_folder("Share", "Web page")
    path = desk.download("Web page", tmp_path)
    assert path.suffix == ".html" and "forest" in path.read_text()
    path = desk.download("Log", tmp_path)
    assert path.read_bytes()[:5] == b"\x89MCAP"
    before = desk.session.frame.index
    desk.session.step(1).result()  # the session goes on
    assert desk.session.frame.index == before + 1


def test_a_file_has_the_name_of_its_flight_if_another_one_is_opened_meanwhile(restored_desk, monkeypatch):
    desk, is_writing, may_end, write = restored_desk, threading.Event(), threading.Event(), FlightFiles.write

    def slow_write(self, frames, path, **options) -> None:
        frames = list(frames)
        is_writing.set()
        assert may_end.wait(TIMEOUT)
        write(self, frames, path, **options)

    monkeypatch.setattr(FlightFiles, "write", slow_write)
    desk.open_folder("Share", "Log")
    with desk.page.expect_download() as download:
        desk.click("Log")
        assert is_writing.wait(TIMEOUT)
        desk.choose("Scene", "pillars")
        desk.click("Open")
        link = desk.control("Link").locator("input")
        desk.session.pause()
        desk.wait_for(lambda: "source=pillars" in link.input_value(), "the other scene")
        desk.wait_for(lambda: desk.session.config == desk.known(PlannerConfig()), "the facts of its flight")
        may_end.set()
    assert download.value.suggested_filename == "forest.mcap"


def test_the_picture_shows_what_the_visitor_sees(browser, tmp_path):
    # At full resolution: a coarse page draws only parts of a thin line, whose middle is then elsewhere.
    with open_desk(browser, quick_forest(), ticks=10, layers=["drone", "rollouts"]) as desk:
        desk.click("top")
        desk.open_tab("Layers")
        desk.checkbox("Drone").uncheck()
        desk.page.get_by_role("tab", name="Legend").click()
        desk.open_tab("Fly")
        desk.open_folder("Share", "Picture")
        path = desk.download("Picture", tmp_path)
        desk.wait_for(lambda: desk.dashboard.server.visitors.count == 1, "the page of the picture to leave")
        desk.dismiss_all()
        desk.settled_screenshot()
        shown, image = iio.imread(desk.page.screenshot())[..., :3], iio.imread(path)[..., :3]
    assert image.shape == shown.shape, "the size of the page"
    np.testing.assert_allclose(chosen_rollout(image), chosen_rollout(shown), atol=6.0, err_msg="the camera")
    assert count(image[:, LEFT:-RIGHT], palette.DRONE) < 20, "the hidden drone"
    legend, header = (slice(400, 600), slice(0, LEFT)), (slice(0, 250), slice(-RIGHT, None))
    for panel in (legend, header):  # the tab, and no line about visitors
        assert differing(blurred(image[panel]), blurred(shown[panel])) < 50


def blurred(image: np.ndarray) -> np.ndarray:
    """Average a picture over 5 x 5 pixels: a panel may lie half a pixel higher on one of two pages."""
    blur: Any = uniform_filter
    return blur(image, size=(5, 5, 1))


def chosen_rollout(image: np.ndarray) -> np.ndarray:
    """First and last row and column of the chosen rollout, outside the panels, shape [2, 2]."""
    near = np.argwhere(np.abs(image[:350, :-RIGHT].astype(int) - palette.CHOSEN).max(axis=-1) <= 40)
    return np.stack([near.min(axis=0), near.max(axis=0)])


def test_a_link_opens_scene_seed_time_and_configuration_after_a_question(restored_desk):
    desk = restored_desk
    config = config_for_flight(PlannerConfig().replace({"costs.q_track": 8.0}), desk.session.frame.source)
    assert config.costs.height_max < PlannerConfig().costs.height_max, "a fact of the flight, which no link needs"
    desk.session.configure(config)
    desk.session.seek(0.1).result()
    desk.open_folder("Share", "Copy link")
    field = desk.control("Link").locator("input")

    def is_present() -> bool:
        shown = Link.parse(field.input_value().partition("?")[2])
        return shown is not None and shown.config == {"costs.q_track": 8.0} and bool(np.isclose(shown.time, 0.1))

    desk.wait_for(is_present, "the link with the configuration and the time")
    link = field.input_value().replace("seed=0", "seed=5")
    before = desk.session.source
    desk.page.goto(link)
    desk.page.get_by_text("Open this link?").wait_for()
    assert desk.session.source is before  # nothing happens without the visitor's consent
    desk.session.configure({"costs.q_track": 15.0})
    desk.page.get_by_role("button", name="Open", exact=True).last.click()
    desk.wait_for(lambda: desk.session.source is not before, "the other forest")
    desk.wait_for(lambda: desk.session.config.costs.q_track == 8.0, "the configuration of the link")
    desk.wait_for(lambda: abs(desk.session.frame.time - 0.1) < 1e-6, "the time of the link")
    assert desk.session.source.settings["seed"] == 5
    assert desk.session.config == config_for_flight(desk.session.config, desk.session.source)
    assert desk.session.config.costs.height_max < PlannerConfig().costs.height_max
    assert "source=" not in desk.page.url


def test_a_link_of_another_page_brings_no_pictures_and_no_markup_onto_the_page(restored_desk):
    desk, requested = restored_desk, []
    desk.page.on("request", lambda request: requested.append(request.url))
    desk.page.goto(desk.dashboard.url + "?source=%21%5Ba%5D%28http%3A//127.0.0.1%3A9/x%29%3Ch1%3Efree%20prize%3C/h1%3E")
    desk.page.get_by_text("![a](http://127.0.0.1:9/x)<h1>free prize</h1>").wait_for()
    assert not [url for url in requested if ":9/" in url]


def test_a_video_is_given_up_when_the_server_ends(fresh_desk, monkeypatch, tmp_path):
    desk = fresh_desk
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    desk.session.step(40).result()
    desk.open_folder("Share", "Video")
    desk.click("Video")
    desk.page.get_by_text(re.compile(r"Video: \d\.\d of 1\.0 s")).first.wait_for()
    desk.wait_for(lambda: bool(list(tmp_path.rglob("*.mp4*"))), "the first picture of the video")
    desk.dashboard.close()
    assert "aero-viz-share" not in {thread.name for thread in threading.enumerate()}
    assert not list(tmp_path.rglob("*.mp4*"))


def test_a_video_says_how_much_of_it_is_written_and_is_given_up_by_a_button(restored_desk, monkeypatch, tmp_path):
    desk = restored_desk
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    desk.session.step(90).result()
    desk.open_folder("Share", "Video")
    desk.click("Video")
    desk.page.get_by_text(re.compile(r"^Video: \d\.\d of 2\.0 s written \(\d+ %\)$")).first.wait_for()
    assert list(tmp_path.rglob("*.mp4*"))
    desk.page.get_by_text("No other file can be written until").wait_for()
    desk.click("Log")
    refusal = desk.refusal("wait until it is done, or cancel it")
    refusal.wait_for()
    desk.dismiss(refusal)
    desk.click("Cancel writing")
    desk.page.get_by_text("Video was not written, since that was cancelled.").wait_for()
    assert not list(tmp_path.rglob("*.mp4*"))
    desk.page.get_by_role("button", name="Cancel writing").wait_for(state="hidden")
    assert desk.download("Log", tmp_path).suffix == ".mcap", "another file can be written"
