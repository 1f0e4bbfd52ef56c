"""The drone and its plan stay visible behind obstacles, from every camera."""

import numpy as np
import pytest

from aero_viz.dashboard import palette
from aero_viz.flight import FlightSource
from aero_viz.scenes import World
from tests.browser.desk import open_desk
from tests.browser.pictures import count

START, GOAL = np.array([0.0, 0.0, 2.0]), np.array([20.0, 0.0, 2.0])
ROOM = World(
    "room with a pillar",
    START,
    GOAL,
    cylinders=np.array([[-3.0, 0.1, 0.0, 0.0, 0.0, 1.0, 0.7, 6.0]]),
    boxes=np.array([[10.0, 0.0, 6.0, 40.0, 40.0, 0.2, 0.0], [0.0, -5.0, 3.0, 40.0, 0.2, 6.0, 0.0]]),
)


@pytest.fixture(scope="module")
def room(browser):
    """A pillar behind the drone, a ceiling above it, and a wall beside it."""
    with open_desk(browser, FlightSource(ROOM), ticks=20, size=(1280, 720), layers=["rollouts", "obstacles"]) as desk:
        yield desk
        assert desk.console == []
        assert desk.dashboard.failures == 0


@pytest.mark.parametrize("camera", ["follow", "top", "side"])
def test_the_chosen_rollout_is_seen_from_every_camera(room, camera):
    room.click(camera)
    room.wait_for(
        lambda: count(room.screenshot(), palette.CHOSEN, tolerance=60) > 100, f"the chosen rollout from {camera}"
    )


def test_an_obstacle_is_faint_from_one_side_and_solid_from_the_other(room):
    room.click("follow")
    faint = room.dashboard.layers["obstacles"].faint
    room.wait_for(lambda: room.camera.position[0] < -3.0 and faint.visible, "a faint pillar")
    room.settled(lambda: room.camera.position, "the camera's first view")
    canvas = room.page.locator("canvas").first.bounding_box()
    room.drag((450.0, 600.0), (canvas["height"] / 2, 0.0))  # half a turn around the drone
    room.wait_for(lambda: not faint.visible, "a solid pillar, although time stands still")


def test_first_views_are_outside_of_walls_and_solids(room):
    room.click("side")
    room.wait_for(lambda: -4.9 < room.camera.position[1] < -1.5, "a camera on the drone's side of the wall")
    assert ROOM.distance(np.asarray(room.camera.position)[None])[0] > 0.1
