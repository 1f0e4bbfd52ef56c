"""A page in a hidden tab goes on reading what the flight sends."""

from tests.browser.desk import COARSE, open_desk, quick_forest
from tests.browser.hiding import HIDE


def test_a_hidden_tab_reads_on(browser):
    with open_desk(browser, quick_forest(), ticks=10, resolution=COARSE, layers=["drone"], script=HIDE) as desk:
        desk.wait_for(lambda: desk.page.evaluate("Boolean(window.aeroHidden)"), "the script")
        desk.page.evaluate("hide(true)")
        desk.session.play()
        for _ in range(2):  # viser answers between two pictures
            desk.render([0.0, 0.0, 5.0], [5.0, 0.0, 2.0])
        desk.session.pause()
        desk.page.evaluate("hide(false)")
        desk.render([0.0, 0.0, 5.0], [5.0, 0.0, 2.0])
