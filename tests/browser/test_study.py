"""A study on the page: its front, a click that makes B, and a search that goes on meanwhile."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from small_source import small_config, small_source

from aero_viz.evaluation.tune import FlightOptions, ParameterRange, SearchOptions, StoredStudy, tune
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from tests.browser.desk import COARSE, TIMEOUT, open_desk, visit


def world() -> World:
    world = small_source(goal=7.0).info.world
    assert world is not None
    return world


def fly(storage: str, *, trials: int) -> None:
    ranges = [ParameterRange("vehicle.speed_limit", 1.0, 8.0), ParameterRange("costs.q_track", 0.5, 50.0)]
    search = SearchOptions(trials, generation=8, rungs=1, objectives=("time", "clearance"), sampler="random")
    flight = FlightOptions(lidar=LidarModel("sparse", points_per_sweep=500))
    tune(
        small_config(), ranges, [world()], [world()], search=search, flight=flight, storage=storage, study_name="poles"
    )


def test_a_point_of_the_front_becomes_b_and_the_page_follows_the_study(browser, tmp_path: Path) -> None:
    storage = f"sqlite:///{tmp_path}/tune.db"
    fly(storage, trials=8)
    study = StoredStudy(storage, "poles")
    front = {point.trial: point for point in study.read().points if point.on_front}
    source = small_source(goal=7.0)
    present = config_for_flight(small_config(), source.info)
    with open_desk(
        browser, source, ticks=5, config=present, resolution=COARSE, layers=["drone"], size=(1000, 900), study=study
    ) as desk:
        session: Any = desk.session
        desk.open_tab("Study")
        desk.page.get_by_text("8 of 8 candidates, 9 flights").wait_for()
        points = desk.page.locator(".aero-candidate")
        trials = [int(point.get_attribute("data-trial") or "") for point in points.all()]
        assert set(trials) == set(front) - {None}
        desk.wait_for(lambda: desk.page.locator(".aero-importance").count() == 2, "the importance of both parameters")
        # The fastest and the slowest candidate: points between them may cover each other. A click at a place would miss
        # one that is drawn again meanwhile.
        for trial in sorted(trials, key=lambda trial: front[trial].estimates["time [s]"].value)[:: len(trials) - 1]:
            desk.page.locator(f'.aero-candidate[data-trial="{trial}"]').dispatch_event("click")
            expected = front[trial].config
            desk.wait_for(lambda: session.config.costs.q_track == expected.costs.q_track, f"trial {trial} as B")  # noqa: B023
            assert session.comparison.pinned == present
            assert set(present.differences(session.config)) == {"vehicle.speed_limit", "costs.q_track"}
            assert session.config.vehicle.speed_limit == expected.vehicle.speed_limit
        desk.wait_for(lambda: session.comparison.frame is not None, "a plan of A")
        desk.wait_for(lambda: session.frame.config == session.config, "a plan of B")
        desk.control("y axis").locator("input").first.click()
        desk.page.get_by_role("option", name="arrived [%]").click()
        desk.page.locator(".aero-front").wait_for()
        fly(storage, trials=10)
        desk.page.get_by_text("10 of 10 candidates, 11 flights").wait_for()
        (tmp_path / "tune.db").write_bytes(b"damaged" * 1000)
        desk.page.get_by_text("cannot be read").wait_for()
        assert desk.page.locator(".aero-candidate").count()  # what was read stays
        assert desk.console == [] and desk.dashboard.failures == 0


def test_tune_serves_the_page_while_it_flies(browser, tmp_path: Path) -> None:
    """The page counts up while the search goes on, Ctrl-C in the terminal ends the search, a second one the page."""
    world().save(tmp_path / "poles.json")
    arguments = ["poles.json", "--over", "vehicle.speed_limit=2:8", "--sampling.samples", "16", "--trials", "400"]
    arguments += ["--flights", "1", "--rungs", "1", "--generation", "1", "--lidar.points-per-sweep", "500"]
    arguments += ["--storage", "sqlite:///tune.db", "--page", "--port", "0"]
    process = subprocess.Popen(
        [sys.executable, "-m", "aero_viz", "tune", *arguments], cwd=tmp_path, text=True, process_group=0,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(Path.cwd()), str(Path.cwd() / "planner")])},
    )  # fmt: skip
    try:
        assert process.stdout and process.stderr
        address = re.search(r"AERO-Viz shows poles.json at (\S+)", process.stderr.readline())
        assert address
        page = visit(browser, address[1], size=(1000, 900), resolution=COARSE)
        page.get_by_role("tab", name="Study").click()

        def count() -> int:
            text = page.locator(".aero-study").inner_text()
            return int(re.search(r"(\d+) of 400 candidates", text)[1])  # type: ignore[index]

        first = count()
        page.wait_for_function(
            "n => parseInt(document.querySelector('.aero-study').innerText.match(/(\\d+) of 400/)[1]) > n",
            arg=first, polling=200,
        )  # fmt: skip
        page.locator(".aero-candidate").first.wait_for()  # one that arrived; the first ones may not
        process.send_signal(signal.SIGINT)
        table = process.stdout.readline() + process.stdout.readline()
        assert "Wilson 95 %" in table
        page.locator(".aero-candidate").first.wait_for()
        assert count() > first
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 130
        page.close()
    finally:
        process.kill()
