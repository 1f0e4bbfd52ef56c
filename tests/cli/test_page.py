"""The commands that serve the page, as processes, with a browser. `test_serving.py` has the tests without one."""

from pathlib import Path

from playwright.sync_api import Browser
from small_source import small_config

from aero_viz.flight import fly
from aero_viz.logs import flight_recorder
from aero_viz.scenes import World
from tests.browser.desk import COARSE, visit
from tests.cli.programs import StartPython, interrupt, read_line, read_url


def test_ctrl_c_does_not_wait_for_a_source_that_is_being_opened(
    start_python: StartPython, browser: Browser, poles: str, tmp_path: Path
):
    slow = tmp_path / "slow.json"
    slow.write_text("[" + "[0, 0, 0]," * 5_000_000 + "0]")  # 50 MB
    process = start_python("-m", "aero_viz", "demo", poles, "--port", "0", "--paused", "--folder", str(tmp_path))
    url = read_url(process)
    with visit(browser, url, resolution=COARSE) as page:
        row = page.locator("label", has_text="Path").locator("xpath=ancestor::div[contains(@class, 'Flex')][1]")
        row.locator("input").fill(str(slow))
        page.get_by_role("button", name="Open path", exact=True).click()
        page.get_by_text(f"Opening {slow}").first.wait_for(timeout=90_000)
        interrupt(process)


def test_no_headless_flies_in_the_page(start_python: StartPython, short_poles: str, browser: Browser):
    """Playback starts when the page is open in a real Chromium, and the drone arrives."""
    options = ["--no-headless", "--port", "0", "--speed", "5", "--sampling.samples", "16"]
    process = start_python("-m", "aero_viz", "fly", short_poles, *options)
    url = read_url(process)
    with visit(browser, url, resolution=COARSE) as page:
        page.get_by_text("arrived at the goal").first.wait_for(timeout=180_000)
    interrupt(process)


def test_two_logs_are_compared_in_the_terminal_and_on_one_page(
    start_python: StartPython, short_poles: str, browser: Browser, tmp_path: Path
):
    a, b = str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap")
    for path, speed in ((a, 2.0), (b, 3.0)):
        fly(World.load(short_poles), config=small_config(), speed=speed, recorder=flight_recorder(path))
    process = start_python("-m", "aero_viz", "compare", a, b, "--page", "--port", "0")
    printed = ""
    while " at http" not in (line := read_line(process)):
        assert process.poll() is None
        printed += line
    assert "vehicle.speed_limit" in printed and f"{b} with the ghost of {a}" in line
    with visit(browser, line.split(" at ")[-1].split()[0], resolution=COARSE) as page:
        page.get_by_role("button", name="Curves").click()
        page.get_by_text("dashed: a.mcap").wait_for()
        differs = "Number(document.querySelector('#aero-curve-state').dataset.differs) > 0"
        page.wait_for_function(differs)
    interrupt(process)
