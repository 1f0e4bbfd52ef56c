"""Each layer draws its content at the right place, and nothing while it is hidden."""

import numpy as np
import pytest
from ensemble_plans import plan_of
from numpy.typing import NDArray

from aero_planner import PlannerConfig
from aero_viz.dashboard import palette
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from tests.browser.desk import open_desk
from tests.browser.pictures import count, differing


def behind(desk) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    position = np.asarray(desk.session.frame.observation.state.position)
    return np.add(position, (-3.0, -1.0, 2.5)), np.add(position, (1.5, 0.0, 0.0))


def test_the_goal_is_drawn_at_the_goal(desk):
    goal = np.asarray(desk.session.frame.observation.goal.position)
    desk.dashboard.show_only(["goal"])

    def is_drawn() -> bool:
        image = desk.render(np.add(goal, (-5.0, 0.0, 0.5)), goal)
        return image[300, 320, 0] > 100 and count(image, palette.GOAL) > 50

    desk.wait_for(is_drawn, "red at the middle of the picture")


def test_all_fifteen_rollouts_are_drawn_in_their_colours(desk):
    plan = desk.session.frame.plan
    assert len(plan.positions) == 15
    desk.dashboard.show_only(["rollouts"])
    position, look_at = behind(desk)
    desk.wait_for_rollouts(position, look_at)


# For the switches of the page: layer, colour (None: any change), and the least number of pixels in a screenshot.
SWITCHED = [
    ("rollouts", palette.CHOSEN, 100),
    ("samples", None, 1000),
    ("guides", palette.GUIDE, 200),
    ("anchors", palette.ANCHOR, 60),
    ("cloud", None, 5000),
    ("fine_cells", None, 20_000),
    ("unseen_cells", None, 5000),
    ("occluded_space", None, 1000),
    ("coarse_cells", None, 5000),
    ("drone", None, 150),
    ("trail", palette.DRONE, 100),
    ("goal", None, 30),
    ("obstacles", None, 20_000),
    ("ground", None, 1000),
]


@pytest.fixture(scope="module")
def bare(browser):
    """A page whose layers were all switched off with the mouse, and a screenshot of it."""
    # The window is small until the layers are off, since it is drawn in software.
    with open_desk(browser, ticks=50, config=PlannerConfig.preset("paper"), size=(800, 300)) as desk:
        desk.open_tab("Layers")
        switches = [layer for layer in desk.dashboard.layers.values() if layer.available]
        for layer in reversed(switches):  # the obstacles first, which take longest to draw
            box = desk.checkbox(layer.title)
            assert box.is_checked() == layer.on_by_default
            if layer.on_by_default:
                box.click()
        desk.wait_for(lambda: not any(layer.visible for layer in switches), "all layers to be off")
        desk.page.set_viewport_size({"width": 1280, "height": 720})
        desk.wait_for(lambda: desk.screenshot().shape[0] == 720 and desk.screenshot().max() < 100, "an empty scene")
        yield desk, desk.settled_screenshot()
        assert desk.console == []


@pytest.mark.parametrize(("name", "color", "least"), SWITCHED, ids=[name for name, _, _ in SWITCHED])
def test_clicks_on_a_switch_show_and_hide_its_layer(bare, name, color, least):
    desk, empty = bare
    box = desk.checkbox(desk.dashboard.layers[name].title)

    def drawn() -> int:
        image = desk.screenshot()
        return differing(image, empty) if color is None else count(image, color)

    assert drawn() < least // 10 + 1
    box.click()
    desk.wait_for(lambda: drawn() >= least, f"{least} pixels of {name}")
    assert box.is_checked()
    box.click()
    desk.wait_for(lambda: differing(desk.screenshot(), empty) == 0, f"{name} to be gone")
    assert not box.is_checked()


def test_every_layer_of_a_flight_has_its_switch_tested(bare):
    desk, _ = bare
    layers = {name for name, layer in desk.dashboard.layers.items() if layer.available}
    # Empty until something is selected (test_why.py), where nothing moves, and without a mission (test_mission.py).
    assert {name for name, *_ in SWITCHED} == layers - {"selection", "motion", "mission"}


def test_what_moves_is_drawn_where_it_is_predicted(browser):
    with open_desk(browser, FlightSource(scene("moving", seed=3)), ticks=150, layers=["motion"]) as desk:
        frame = desk.session.frame
        moving = plan_of(frame).moving
        assert frame is not None and moving is not None and len(moving.radii) > 0
        look_at = np.array([*moving.positions[0], np.asarray(frame.observation.actual_state.position)[2]])

        def drawn() -> int:
            return count(desk.render(np.add(look_at, (-3.0, 0.0, 3.0)), look_at), palette.MOVING)

        desk.wait_for(lambda: drawn() >= 100, "rings around what moves")
        desk.dashboard.show_only([])
        desk.wait_for(lambda: drawn() == 0, "no rings")
