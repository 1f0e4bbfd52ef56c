"""The drone and its plan stay visible behind obstacles, from every camera."""

import numpy as np
import pytest
from scipy.ndimage import label

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source
from aero_viz.dashboard import palette
from aero_viz.dashboard.outlook import Sight
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW
from aero_viz.flight import FlightSource
from aero_viz.scenes import World
from aero_viz.session import Frame
from tests.browser.desk import COARSE, open_desk
from tests.browser.pictures import count, differing

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


def test_the_follow_camera_looks_past_the_pillar(room):
    room.click("follow")
    room.wait_for(lambda: room.camera.position[0] < -2.0, "the view from behind")
    position = room.settled(lambda: room.camera.position, "the camera's first view")
    assert Sight().blocking(room.session.frame, position, room.session.frame.drone_position) == 0
    assert not room.dashboard.layers["obstacles"].faint_obstacles


def test_an_obstacle_is_faint_from_one_side_and_solid_from_the_other(room):
    room.click("free")
    room.camera.position, room.camera.look_at = np.array([-6.0, 0.0, 2.6]), np.array([1.6, 0.0, 2.0])
    faint = room.dashboard.layers["obstacles"].faint
    room.wait_for(lambda: faint.visible, "a faint pillar, in the view that was chosen")
    canvas = room.page.locator("canvas").first.bounding_box()
    room.drag((450.0, 600.0), (canvas["height"] / 2, 0.0))  # half a turn around the drone
    room.wait_for(lambda: not faint.visible, "a solid pillar, although time stands still")


def test_from_above_the_ceiling_and_its_points_are_gone_and_come_back(room):
    room.dashboard.show_only(["rollouts", "obstacles", "cloud"])
    obstacles, cloud = (room.dashboard.layers[name] for name in ("obstacles", "cloud"))

    def tops() -> tuple[float, float]:
        scales, places = obstacles.solids["boxes"].batched_scales, obstacles.solids["boxes"].batched_positions
        seen = scales.min(axis=1) > 1e-3
        return float((places[seen, 2] + 0.5 * scales[seen, 2]).max()), float(cloud.node.points[:, 2].max())

    room.click("side")
    room.wait_for(lambda: tops()[0] > 5.9 and tops()[1] > 5.0, "the ceiling from the side")
    room.click("top")
    room.wait_for(lambda: max(tops()) < 3.1, "nothing above the drone")
    room.wait_for(lambda: count(room.screenshot(), palette.CHOSEN, tolerance=60) > 100, "the chosen rollout")
    room.dashboard.show_only(["rollouts", "obstacles"])


def test_the_chosen_rollout_is_seen_through_cells(room):
    room.click("follow")
    room.wait_for(lambda: count(room.screenshot(), palette.CHOSEN, tolerance=60) > 100, "the chosen rollout")
    room.open_tab("Layers")
    before = room.settled_screenshot()
    room.checkbox("Occupied cells").click()
    room.wait_for(lambda: differing(room.screenshot(), before) > 5000, "cells")
    after = room.settled_screenshot()
    green = [
        np.clip(image[..., 1].astype(int) - image[..., ::2].max(axis=-1), 0, None) > 25 for image in (before, after)
    ]
    assert green[1].sum() > 0.5 * green[0].sum()
    room.checkbox("Occupied cells").click()


def test_points_keep_their_size_in_the_world(room):
    room.dashboard.show_only(["anchors"])
    anchors = np.asarray(room.session.frame.plan.anchors)[: room.session.config.anchor_count]
    between = np.linalg.norm(anchors[:, None] - anchors, axis=-1) + 1e3 * np.eye(len(anchors))
    point = anchors[between.min(axis=1).argmax()].astype(float)

    def width(distance: float) -> float:
        eye = point + distance * np.array([-1.0, 0.0, 0.0])
        image = room.render(eye, point, width=600, height=600)[..., :3].astype(int)
        pieces: np.ndarray = label(np.abs(image - palette.ANCHOR).max(axis=-1) <= 40)[0]  # type: ignore[index]
        return 2.0 * np.sqrt((pieces == pieces[300, 300]).sum() / np.pi) if pieces[300, 300] else 0.0

    room.wait_for(lambda: width(1.0) > 10.0, "the anchor")
    focal = 300.0 / np.tan(0.5 * FIELD_OF_VIEW)
    for distance in (1.0, 2.0):
        assert width(distance) == pytest.approx(0.16 * focal / distance, rel=0.25)
    room.dashboard.show_only(["rollouts", "obstacles"])


def test_a_drone_that_hits_the_ground_is_seen_from_the_side(browser):
    config = PlannerConfig.preset("paper")
    source = open_source("double_wall_trap", seed=1)
    with open_desk(browser, source, ticks=5, config=config, resolution=COARSE, layers=["drone", "ground"]) as desk:

        def frame() -> Frame:
            assert desk.session.frame is not None
            return desk.session.frame

        def elevation() -> float:
            offset = desk.camera.position - frame().drone_position
            return float(np.degrees(np.arctan2(offset[2], np.hypot(*offset[:2]))))

        desk.click("follow")
        desk.wait_for(lambda: elevation() > 20.0, "the view from behind")
        while frame().outcome is None:
            desk.session.step(10).result()
        assert frame().outcome == "collision"
        desk.wait_for(lambda: 0.0 < elevation() < 16.0, "a view from the side")
        assert np.linalg.norm(desk.camera.look_at - frame().drone_position) < 0.3, "no panel hides it"
        desk.session.seek(0.1).result()
        desk.wait_for(lambda: frame().outcome is None and elevation() > 20.0, "the view from behind again")


def test_first_views_are_outside_of_walls_and_solids(room):
    room.click("side")
    room.wait_for(lambda: -4.9 < room.camera.position[1] < -1.5, "a camera on the drone's side of the wall")
    assert ROOM.distance(np.asarray(room.camera.position)[None])[0] > 0.1
