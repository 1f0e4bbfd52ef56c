"""Obstacles that are added, thrown, dragged, resized, removed and saved on the page of a flight."""

from typing import Any

import numpy as np
import pytest

from aero_viz.catalog import open_source
from aero_viz.scenes import World, scene
from aero_viz.scenes.obstacles import KINDS, Obstacle, ObstacleKey, new_obstacle, obstacle_at, with_obstacle
from tests.browser.desk import COARSE, Desk, open_desk, quick_forest

TREES = 20
FOREST = scene("forest", seed=0, count=TREES)
ARROW = 80.0
"""Length of the arrows of the selected obstacle [pixels]."""
GROUND = (600.0, 650.0)
"""A place on the page with nothing but ground."""


@pytest.fixture(scope="module")
def page(browser):
    """A flight through the forest with its obstacles and the tab that changes them."""
    with open_desk(
        browser, quick_forest(count=TREES), ticks=10, size=(1280, 720), resolution=COARSE, layers=["obstacles", "drone"]
    ) as desk:
        desk.open_tab("World")
        yield desk
        assert desk.console == [] and desk.dashboard.failures == 0


@pytest.fixture
def desk(page):
    """The page 0.2 s into the flight, with the forest as it was."""
    page.session.seek(0.0).result()
    page.session.step(10).result()
    page.page.get_by_text("Selected:").wait_for(state="hidden")  # by the test before
    return page


def world_of(desk: Desk) -> World:
    return desk.session.frame.world  # type: ignore[union-attr, return-value]


def added(desk: Desk, kind: str) -> Obstacle | None:
    """The obstacle of a kind that was added on the page."""
    return obstacle_at(world_of(desk), ObstacleKey(KINDS[kind], len(getattr(FOREST, KINDS[kind]))))


def present(desk: Desk, kind: str) -> Obstacle:
    obstacle = added(desk, kind)
    assert obstacle is not None
    return obstacle


def throw(desk: Desk) -> str:
    """Throw an obstacle and return its name."""
    desk.click("Throw an obstacle")
    name = f"sphere {len(FOREST.spheres)}"
    desk.page.get_by_text(f"Selected: {name}").wait_for()
    return name


def magenta(desk: Desk) -> int:
    """Number of pixels in the hue of a selection, in light and in shade."""
    red, green, blue = np.moveaxis(desk.screenshot().astype(int), 2, 0)
    return int(((red > 110) & (blue > 90) & (green < 0.6 * red)).sum())


def test_a_thrown_obstacle_lies_on_the_plan_and_a_click_on_it_selects_it(desk):
    plan = desk.session.frame.plan
    name = throw(desk)
    assert present(desk, "sphere").center == pytest.approx(plan.positions[int(plan.best), -1], abs=1e-4)
    desk.checkbox("Edit obstacles").click()
    desk.page.get_by_text("Selected:").wait_for(state="hidden")
    desk.wait_for(lambda: magenta(desk) < 50, "no selection in the scene")
    desk.checkbox("Edit obstacles").click()
    desk.page.get_by_text("Click an obstacle").first.wait_for()
    desk.page.mouse.click(*desk.place_on_page(present(desk, "sphere").center))
    desk.page.get_by_text(f"Selected: {name}").wait_for()
    desk.wait_for(lambda: magenta(desk) > 500, "the selection in the scene")
    desk.page.mouse.click(*GROUND)
    desk.page.get_by_text("Click an obstacle").first.wait_for()


def test_a_click_passes_through_a_faint_obstacle_and_the_arrows_leave_room_for_another_one(desk):
    eye, drone = np.asarray(desk.camera.position), desk.session.frame.drone_position
    hiding = new_obstacle("cylinder", eye + 0.3 * (drone - eye), (0.4, 0.4, 4.0))
    behind = eye + 1.2 * (drone - eye)
    beside = np.add(behind, (0.0, 1.2, 0.0))

    def build(source: Any) -> None:
        world = with_obstacle(source.observe().world, hiding, ObstacleKey("cylinders", 0))
        for place in (behind, beside):
            world = with_obstacle(world, new_obstacle("sphere", place, (0.4, 0.4, 0.4)))
        source.set_world(world)

    desk.session.alter(build).result()
    layer = desk.dashboard.layers["obstacles"]
    desk.wait_for(lambda: ObstacleKey("cylinders", 0) in layer.faint_obstacles, "a faint tree")
    if not desk.checkbox("Edit obstacles").is_checked():
        desk.checkbox("Edit obstacles").click()
    for row, place in enumerate((behind, beside), len(FOREST.spheres)):
        desk.page.mouse.click(*desk.place_on_page(place))
        desk.page.get_by_text(f"Selected: sphere {row}").wait_for()
        desk.wait_for(lambda: magenta(desk) > 50, "the selection in the scene")
    desk.page.mouse.click(*GROUND)
    desk.page.get_by_text("Click an obstacle").first.wait_for()


def test_every_kind_can_be_added_and_an_added_box_be_moved_resized_turned_and_removed(desk):
    for kind in KINDS:
        desk.page.get_by_role("button", name=kind, exact=True).click()
        desk.wait_for(lambda kind=kind: added(desk, kind) is not None, f"the {kind}")
        size = present(desk, kind).size
        desk.wait_for(lambda size=size: values(desk, "Size [m]") == pytest.approx(size), "the size in numbers")
    desk.page.mouse.click(*GROUND)
    desk.page.get_by_text("Click an obstacle").first.wait_for()
    desk.page.get_by_role("button", name="box", exact=True).click()
    row = len(FOREST.boxes) + 1
    desk.page.get_by_text(f"Selected: box {row}").wait_for()

    def box() -> Obstacle:
        obstacle = obstacle_at(world_of(desk), ObstacleKey("boxes", row))
        assert obstacle is not None
        return obstacle

    for label, column, value, read in (
        ("Size [m]", 2, 2.5, lambda: box().size[2]),
        ("Centre [m]", 0, 7.0, lambda: box().center[0]),
        ("Heading [deg]", 0, 45.0, lambda: np.degrees(box().yaw)),
    ):
        field = desk.control(label).locator("input").nth(column)
        desk.enter(field, value)
        desk.wait_for(lambda read=read, value=value: abs(read() - value) < 1e-3, f"{label} {value}")
    assert box().size == pytest.approx([1.0, 1.0, 2.5])
    desk.click("Remove")
    desk.wait_for(lambda: len(world_of(desk).boxes) == row, "the removal")
    desk.page.get_by_text("Click an obstacle").first.wait_for()


def test_one_diameter_of_a_sphere_changes_all_and_a_size_that_cannot_be_is_refused(desk):
    throw(desk)
    field = desk.control("Size [m]").locator("input").nth(1)
    field.select_text()
    field.press_sequentially("0.4", delay=150)
    field.press("Enter")
    desk.wait_for(lambda: present(desk, "sphere").size == pytest.approx([0.4] * 3), "a smaller sphere")
    desk.wait_for(lambda: values(desk, "Size [m]") == pytest.approx([0.4] * 3), "the other sizes")
    desk.enter(field, "-3")
    refusal = desk.refusal("radius = -1.5")
    refusal.wait_for()
    desk.dismiss(refusal)
    desk.wait_for(lambda: values(desk, "Size [m]") == pytest.approx([0.4] * 3), "the size that stays")


def test_numbers_typed_in_two_fields_in_a_row_both_count(desk):
    throw(desk)
    place = present(desk, "sphere").center
    desk.control("Centre [m]").locator("input").nth(2).fill("3.5")
    desk.enter(desk.control("Size [m]").locator("input").nth(0), "0.8")
    desk.wait_for(lambda: present(desk, "sphere").size == pytest.approx([0.8] * 3), "a smaller sphere")
    desk.wait_for(lambda: present(desk, "sphere").center == pytest.approx([*place[:2], 3.5], abs=1e-3), "a higher one")


def test_ctrl_z_and_the_button_take_back_what_was_done_to_an_obstacle(desk):
    throw(desk)
    place = present(desk, "sphere").center
    desk.enter(desk.control("Centre [m]").locator("input").nth(2), "3.5")
    desk.wait_for(lambda: present(desk, "sphere").center[2] == pytest.approx(3.5), "a higher sphere")
    desk.page.mouse.click(*desk.place_on_page(present(desk, "sphere").center))  # out of the field
    desk.click("Remove")
    desk.wait_for(lambda: added(desk, "sphere") is None, "the removal")
    desk.page.keyboard.press("Control+z")
    desk.wait_for(lambda: added(desk, "sphere") is not None, "the sphere again")
    desk.click("undo")
    desk.wait_for(lambda: present(desk, "sphere").center == pytest.approx(place), "the sphere where it was")
    desk.click("undo")
    desk.wait_for(lambda: added(desk, "sphere") is None, "a world without it")
    desk.page.keyboard.press("Control+Shift+z")
    desk.wait_for(lambda: added(desk, "sphere") is not None, "the sphere once more")
    assert present(desk, "sphere").center == pytest.approx(place)


def test_the_selected_obstacle_stays_selected_when_another_is_removed_and_time_goes_back(desk):
    first = ObstacleKey("spheres", len(FOREST.spheres))
    throw(desk)
    desk.page.get_by_role("button", name="sphere", exact=True).click()
    name = f"Selected: sphere {first.row + 1}"
    desk.page.get_by_text(name).wait_for()
    time = desk.session.frame.time
    desk.session.step(1).result()
    desk.session.alter(lambda s: s.set_world(with_obstacle(s.observe().world, None, first))).result()
    desk.page.get_by_text(f"Selected: sphere {first.row}").wait_for()
    desk.session.seek(time).result()
    desk.page.get_by_text(name).wait_for()


def test_an_obstacle_that_does_not_exist_yet_is_not_removed(desk):
    throw(desk)
    desk.session.seek(0.1).result()
    desk.page.keyboard.press("Delete")
    refusal = desk.refusal("Select an obstacle first")
    refusal.wait_for()
    desk.dismiss(refusal)


def test_an_obstacle_is_dragged_while_it_flies_and_going_back_restores_the_world(desk):
    throw(desk)
    before, start = present(desk, "sphere").center, desk.session.frame.index
    desk.wait_for(lambda: magenta(desk) > 100, "the selection in the scene")
    desk.click("free")
    desk.session.set_speed(0.1)
    desk.session.play()
    desk.wait_for(lambda: desk.session.frame.index > start, "the flight")
    x, y = desk.place_on_page(before)
    desk.drag((x, y - 0.75 * ARROW), (0.0, -60.0))
    desk.wait_for(lambda: present(desk, "sphere").center[2] > before[2] + 0.3, "a higher sphere")
    assert desk.session.playing
    desk.session.pause()
    desk.session.set_speed(1.0)
    after = desk.settled(lambda: present(desk, "sphere").center, "the last move of the mouse")
    time = desk.session.frame.time
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-3)
    desk.session.seek(0.1).result()
    assert added(desk, "sphere") is None
    desk.page.get_by_text("Selected:").wait_for(state="hidden")
    desk.session.seek(time).result()
    np.testing.assert_array_equal(present(desk, "sphere").center, after)
    desk.click("follow")


def test_the_saved_world_opens_again_with_what_was_added(desk, tmp_path):
    throw(desk)
    desk.session.set_goal([30.0, 4.0, 3.0]).result()
    path = desk.download("Save world", tmp_path)
    assert path.suffix == ".json"
    source = open_source(str(path), seed=0)
    world, saved = source.info.world, world_of(desk)
    source.close()
    assert world is not None
    for kind in KINDS.values():
        np.testing.assert_array_equal(getattr(world, kind), getattr(saved, kind))
    np.testing.assert_array_equal(world.bounds, saved.bounds)
    np.testing.assert_array_equal(world.goal, [30.0, 4.0, 3.0])


def values(desk: Desk, label: str) -> list[float]:
    """Numbers in the fields of a row of the panel."""
    return [float(field.input_value() or "nan") for field in desk.control(label).locator("input").all()]
