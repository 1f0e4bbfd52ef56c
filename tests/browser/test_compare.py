"""Two configurations on the same tick and on the same flight, through the page."""

from typing import Any

import numpy as np
from small_source import small_config, small_source

from aero_viz.cost_text import cost_text
from aero_viz.flight import FlightSource
from tests.browser.desk import COARSE, open_desk
from tests.browser.pictures import ghost_pixels


def text(desk) -> str:
    return desk.page.locator("body").inner_text()


def test_a_pinned_configuration_plans_the_same_tick_and_flies_as_the_ghost(browser):
    layers = ["drone", "alternative", "ghost"]
    with open_desk(browser, small_source(goal=8.0), ticks=20, config=small_config(), layers=layers) as desk:
        session: Any = desk.session
        assert ghost_pixels(desk.screenshot()) == 0
        desk.open_tab("Tune")
        desk.click("Compare: pin as A")
        desk.page.get_by_text("A and B are the same configuration").wait_for()
        desk.wait_for(lambda: ghost_pixels(desk.screenshot()) > 20, "the rollouts of A")
        number = desk.parameter("vehicle.speed_limit").locator("input")
        desk.open_folder("Vehicle", "Speed limit [m/s]")
        desk.enter(number, "2")
        desk.wait_for(lambda: session.frame.config.vehicle.speed_limit == 2.0, "B")
        a, b = session.comparison.frame, session.frame
        assert a.time == b.time and a.config.vehicle.speed_limit != 2.0
        costs = [cost_text(frame.plan.stage2_cost[frame.plan.best]) for frame in (a, b)]
        words = [f"S2 by the weights of {name}" for name in "AB"]
        desk.wait_for(lambda: all(cost in text(desk) for cost in (*costs, *words)), "the costs of both plans")
        assert "7.0" in text(desk) and "speed at its end [m/s]" in text(desk)

        time = session.frame.time
        session.set_speed(0.2)  # so that B still flies when A has arrived
        desk.click("Fly A and B from here")
        desk.wait_for(lambda: session.playing or session.frame.time > time, "B to fly")
        past: Any = desk.dashboard.history.past
        desk.wait_for(lambda: past().ghost_outcome == "arrived", "the flight of A to be over")
        desk.wait_for(lambda: past().differs_at is not None, "a difference")
        assert past().ghost_name == "A" and past().ghost[0, 0] == time
        desk.click("Pause")
        assert time < past().differs_at < time + 0.2
        desk.page.get_by_text("A and B differ from").wait_for()
        desk.wait_for(lambda: ghost_pixels(desk.screenshot()) > 20, "the path of A")
        desk.click("Curves")
        desk.page.get_by_text("solid: B · dashed: A").wait_for()
        row = desk.page.locator(".aero-fork").inner_text()
        assert "A" in row and "B" in row and "arrived" in row

        desk.click("Curves")  # whose mark of the difference has the colour of the ghost
        desk.click("Stop comparing")
        desk.page.get_by_role("button", name="Compare: pin as A").wait_for()
        desk.wait_for(lambda: ghost_pixels(desk.screenshot()) == 0, "no ghost")
        assert desk.console == [] and desk.dashboard.failures == 0


def test_both_fly_other_seeds_while_the_page_goes_on(browser):
    def opener(spec: str, **options: Any) -> FlightSource:
        return small_source(goal=2.0)

    source, config = small_source(goal=2.0), small_config()
    with open_desk(browser, source, ticks=3, config=config, resolution=COARSE, layers=["drone"], opener=opener) as desk:
        session: Any = desk.session
        desk.open_tab("Tune")
        assert not desk.page.get_by_role("button", name="Fly 10 seeds").is_visible(), "nothing is pinned"
        desk.click("Compare: pin as A")
        session.configure({"vehicle.speed_limit": 2.0})
        desk.click("Fly 10 seeds")
        table, index = desk.page.locator(".aero-seeds"), session.frame.index
        table.get_by_text("1 of 10 seeds").wait_for()
        assert "95 % interval" in table.inner_text() and "1 of 1" in table.inner_text()
        desk.click("+1")
        desk.wait_for(lambda: session.frame.index == index + 1, "a tick meanwhile")
        table.get_by_text("2 of 10 seeds").wait_for()
        desk.page.get_by_text("Where both do, B takes +").wait_for()
        desk.click("Stop flying seeds")
        desk.page.get_by_role("button", name="Fly 10 seeds").wait_for()
        assert "2 of 10 seeds" in table.inner_text() or "3 of 10 seeds" in table.inner_text(), "what was flown stays"
        assert desk.console == [] and desk.dashboard.failures == 0


def test_a_recording_is_planned_with_both_configurations(browser):
    from aero_viz.catalog import open_source, shipped_recordings

    path, _ = shipped_recordings()["room_mid360"]
    source, config = open_source(str(path)), small_config()
    with open_desk(browser, source, ticks=3, config=config, resolution=COARSE, layers=["alternative"]) as desk:
        session: Any = desk.session
        desk.open_tab("Tune")
        desk.click("Compare: pin as A")
        desk.wait_for(lambda: session.comparison.frame is not None, "a plan of A")
        session.configure({"costs.q_blocked": 0.0, "vehicle.speed_limit": 2.0})
        desk.page.get_by_text("speed at its end [m/s]").wait_for()
        before = session.frame
        desk.click("Fly A and B from here")
        past: Any = desk.dashboard.history.past
        desk.wait_for(lambda: past().ghost_outcome == "end", "A to have planned every tick")
        desk.wait_for(lambda: session.frame.outcome == "end", "B to have played them")
        np.testing.assert_allclose(past().ghost[:, 0], before.source.times[before.index :])
        assert desk.console == [] and desk.dashboard.failures == 0
