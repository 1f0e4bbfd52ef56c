"""A mission that is made and flown with the mouse."""

from aero_planner.mission_progress import MissionProgress
from tests.browser.desk import Desk, open_desk, quick_forest


def progress(desk: Desk) -> MissionProgress:
    state = desk.session.frame.observation.mission  # type: ignore[union-attr]
    assert state is not None
    return state


def waypoints(desk: Desk) -> list[tuple[float, float]]:
    return [(round(w.position[0], 1), round(w.position[1], 1)) for w in progress(desk).mission.waypoints]


def test_waypoints_are_added_by_clicks_reordered_removed_and_flown_through(browser):
    with open_desk(
        browser, quick_forest(count=5), ticks=2, size=(1280, 900), resolution=0.5, layers=["mission", "goal", "drone"]
    ) as desk:
        goal = waypoints(desk)
        desk.open_folder("Mission", "Add waypoints")
        desk.checkbox("Add waypoints").click()
        for count, place in enumerate(((6.0, 1.0, 0.0), (10.0, -1.5, 0.0)), 2):
            desk.page.wait_for_timeout(300)  # the page learns of the callback
            desk.page.mouse.click(*desk.place_on_page(place))
            desk.wait_for(lambda count=count: len(progress(desk).mission) == count, "the waypoint")
        near, far, end = progress(desk).mission.waypoints
        assert abs(near.position[0] - 6.0) < 0.5 and abs(far.position[0] - 10.0) < 0.5
        assert near.position[2] == end.position[2] and [end.position[:2]] == goal
        first, second, _ = waypoints(desk)
        number = desk.control("Waypoint").locator("input")
        desk.wait_for(lambda: number.input_value() == "2", "the new waypoint to be selected")
        desk.click("move up")
        desk.wait_for(lambda: waypoints(desk) == [second, first, *goal], "the other order")
        desk.click("move down")
        desk.wait_for(lambda: waypoints(desk) == [first, second, *goal], "the order before")
        length = progress(desk).mission.length(desk.session.frame.source.world.start)  # type: ignore[union-attr]
        desk.page.get_by_text(f"{length:.1f}", exact=True).wait_for()
        desk.click("remove")
        desk.wait_for(lambda: waypoints(desk) == [first, *goal], "the removal")
        desk.page.get_by_text("of 2", exact=True).wait_for()
        desk.checkbox("Add waypoints").click()
        desk.click("Play")
        desk.wait_for(lambda: progress(desk).passed == 1, "the first waypoint to be passed")
        desk.page.get_by_text("passed", exact=True).nth(1).wait_for()
        desk.wait_for(lambda: number.input_value() == "2", "the next one to be selected")
        assert desk.console == [] and desk.dashboard.failures == 0
