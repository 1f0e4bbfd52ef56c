"""Explanations of a plan, through the page."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from aero_viz.catalog import open_source
from aero_viz.cost_text import cost_text
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.selection import SelectionLayer
from aero_viz.explain.picking import pick
from tests.browser.desk import open_desk
from tests.browser.pictures import count
from tests.explain.conftest import OPEN_ABOVE

INSTANCE = 5
LAYERS = ["rollouts", "selection", "anchors", "drone"]
CONFIG = OPEN_ABOVE.replace({
    "way_out.q_escape": 120.0,
    "costs.q_control": 0.25, "costs.q_position": 6.0, "costs.q_speed": 100.0, "partition.fine_cells": 6,
    "sampling.dt": 0.05, "sampling.temperature": 0.03, "sampling.variance_rate_xy": 1.0,
    "sampling.variance_thrust": 1.0, "candidates.brake_reach": 0.35, "costs.q_track": 5.0,
})  # fmt: skip
"""With it, the flight ends at the ceiling, which was not seen."""


@pytest.fixture(scope="module")
def desk(browser):
    """At the first wall of the trap."""
    source = open_source("double_wall_trap", seed=0)
    with open_desk(browser, source, ticks=6, config=CONFIG, size=(1280, 900), layers=LAYERS) as desk:
        desk.open_tab("Why")
        yield desk
        assert desk.console == [] and desk.dashboard.failures == 0


def selected(desk) -> int | None:
    layer = desk.dashboard.layers["selection"]
    assert isinstance(layer, SelectionLayer)
    return layer.instance


def magenta(desk) -> int:
    return count(desk.screenshot(), palette.SELECTED, tolerance=16)


def test_nothing_is_computed_until_it_is_asked_for(desk):
    assert desk.page.locator(".aero-terms").count() == 0 and magenta(desk) == 0


def test_a_number_below_the_bars_selects_an_instance_everywhere(desk):
    desk.checkbox("Explain the plan").click()
    desk.wait_for(lambda: desk.page.locator(".aero-terms").count() == 16, "a bar for each instance")
    desk.page.get_by_role("button", name=str(INSTANCE), exact=True).click()
    verdict = desk.page.locator(".aero-verdict")
    verdict.wait_for()
    assert "Instance 5" in verdict.inner_text()
    numbers = desk.page.locator(".aero-number")
    assert numbers.all_inner_texts() == [str(m) for m in range(16)]
    assert "font-weight: 700" in (numbers.nth(INSTANCE).get_attribute("style") or "").replace(":700", ": 700")
    assert desk.page.get_by_text("dashed:").count() == 1, "a label of the lines"
    assert desk.page.locator(".aero-plot").count() == 7 and desk.page.locator(".aero-weights").count() == 1
    desk.wait_for(lambda: magenta(desk) > 30, "the selection in the scene")
    frame = desk.session.frame
    text = desk.page.locator(".aero-term-table").inner_text()
    assert cost_text(frame.plan.stage2_cost[INSTANCE]) in text
    assert cost_text(frame.plan.stage1_cost[INSTANCE].min()) in text


def test_the_card_follows_a_changed_weight(desk):
    before = desk.page.locator(".aero-term-table").inner_text()
    desk.session.configure({"costs.q_position": 9.0})
    desk.wait_for(lambda: desk.page.locator(".aero-term-table").inner_text() != before, "another card")


def test_a_click_on_an_anchor_selects_its_instance(desk):
    def on_page(m: int) -> tuple[float, float]:
        return desk.place_on_page(desk.session.frame.plan.anchors[m])

    spots = np.array([on_page(m) for m in range(15)])
    gaps = np.linalg.norm(spots[:, None] - spots[None], axis=2) + 1e3 * np.eye(15)
    on_scene = [is_scene(desk, spot) for spot in spots]  # a window of the page may lie over others
    lone = int(np.where(on_scene, gaps.min(axis=1), 0.0).argmax())
    desk.page.mouse.click(*spots[lone])
    desk.wait_for(lambda: selected(desk) == lone, f"instance {lone}")


def is_scene(desk, on_page: ArrayLike) -> bool:
    """Return True if a click at a place on the page [pixels] meets the scene."""
    x, y = np.asarray(on_page, dtype=float).tolist()
    return desk.page.evaluate("([x, y]) => document.elementFromPoint(x, y)?.tagName === 'CANVAS'", [x, y])


def place_of(desk, kind: str) -> np.ndarray:
    """Return a place [m] near the middle of the page at which a click means a point of the cloud, or a cell."""
    frame, eye = desk.session.frame, np.asarray(desk.camera.position)
    points = np.asarray(frame.plan.filtered_points, dtype=np.float64)
    toward, distances = np.asarray(desk.camera.look_at) - eye, np.linalg.norm(points - eye, axis=1, keepdims=True)
    # For a cell, a ray that passes its point farther than a click on the point may.
    offsets = (0.0,) if kind == "point" else (0.025, 0.035, 0.045)
    targets = np.concatenate([points + offset * distances * (0.0, 0.0, 1.0) for offset in offsets])
    rays = (targets - eye) / np.linalg.norm(targets - eye, axis=1, keepdims=True)

    # A ray cast takes 2 ms, and neighbours have the same result.
    for target in targets[np.argsort(-rays @ toward)][::8]:
        # The mouse is only as exact as a pixel.
        near = target + 0.003 * np.linalg.norm(target - eye) * np.array(
            ((0, 0, 0), (0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0))
        )
        picked = (pick(frame, eye, (place - eye) / np.linalg.norm(place - eye), cells=True) for place in near)
        is_meant = all(found is not None and found.kind == kind for found in picked)
        if is_meant and is_scene(desk, desk.place_on_page(target)):
            return target
    raise AssertionError(f"no {kind} can be clicked")


@pytest.mark.parametrize(("kind", "layer"), [("point", "cloud"), ("cell", "fine_cells")])
def test_a_click_on_a_point_or_a_cell_shows_its_range_age_and_sweep(desk, kind: str, layer: str):
    desk.dashboard.show_only(["selection", layer])
    seen, selection, target = desk.session.frame.observation, desk.dashboard.layers["selection"], place_of(desk, kind)
    before = selection.point
    desk.page.mouse.click(*desk.place_on_page(target))
    desk.wait_for(lambda: selection.point is not None and selection.point is not before, f"the {kind}")
    point, eye = selection.point, np.asarray(desk.camera.position)
    rays = [(place - eye) / np.linalg.norm(place - eye) for place in (target, point)]
    assert np.arccos(rays[0] @ rays[1]) < 0.06  # what was clicked
    card = desk.page.locator(".aero-point")
    card.get_by_text(f"{np.linalg.norm(point - seen.state.position):.2f} m", exact=True).first.wait_for()
    number = int(np.argmin([np.linalg.norm(sweep - point, axis=1).min() for sweep in seen.sweeps]))
    words = card.inner_text()
    assert f"{number + 1} of {len(seen.sweeps)}" in words and "row " in words
    assert f"{seen.time - seen.sweep_times[number]:.2f} s since the end" in words
    desk.wait_for(lambda: magenta(desk) > 5, "the point in the scene")
    desk.dashboard.show_only(LAYERS)
    desk.page.get_by_role("button", name=str(INSTANCE), exact=True).click()
    desk.wait_for(lambda: selected(desk) == INSTANCE and selection.point is None, "an instance instead")


def test_a_failed_flight_has_a_report_that_leads_to_the_tick_in_question(desk):
    desk.session.configure({"costs.q_position": 3.0})
    desk.session.step(60).result()
    assert desk.session.frame.outcome == "collision"
    report = desk.page.locator(".aero-report")
    report.wait_for()
    assert "It hit box 7" in report.inner_text() and "outside the field of view" in report.inner_text()
    desk.click("Go to that tick")
    desk.wait_for(lambda: desk.session.frame.outcome is None and desk.session.frame.time < 0.5, "that tick")
    assert f"braking would have worked is {desk.session.frame.time:.2f} s" in report.inner_text()


def test_the_live_parameters_that_change_a_frozen_tick_are_listed(desk):
    desk.click("Sensitivity of this tick")
    table = desk.page.locator(".aero-sensitivity")
    table.wait_for()
    assert f"plan at {desk.session.frame.time:.2f} s" in table.inner_text() and "+20%" in table.inner_text()
    assert 1 <= table.locator("[title*='.']").count() <= 10, "a row for each of the strongest"
    desk.page.get_by_role("button", name="Sensitivity of this tick", disabled=False).wait_for()


def test_a_change_against_the_cause_is_applied_and_the_same_seed_flown_again(desk):
    session, info = desk.session, desk.session.frame.source
    assert "paused" in desk.page.locator("body").inner_text()
    before = session.config
    times = []
    sink = session.subscribe(lambda frame: times.append(frame.time), every=True, name="test")
    desk.page.get_by_role("button", name="Speed limit [m/s]:").click()
    desk.wait_for(lambda: session.playing and 0.0 in times, "a flight from the beginning")
    session.pause()
    session.unsubscribe(sink)
    changed = before.differences(session.config)
    assert list(changed) == ["vehicle.speed_limit"] and changed["vehicle.speed_limit"][1] < 7.0
    assert session.frame.source is info, "the same flight"
    session.step(0).result()


def test_it_goes_on_while_the_flight_runs_and_stops_when_it_is_switched_off(desk):
    desk.session.step(5).result()
    desk.wait_for(lambda: desk.page.locator(".aero-verdict").count() == 1, "the card of a later tick")
    desk.checkbox("Explain the plan").click()
    desk.wait_for(lambda: selected(desk) is None and magenta(desk) == 0, "no selection")
    desk.wait_for(lambda: desk.page.locator(".aero-terms").count() == 0, "no bars")
