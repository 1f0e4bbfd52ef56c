"""Light and dark pages, and the tabs that a browser remembers."""

import imageio.v3 as iio
import numpy as np

from aero_viz.dashboard import palette
from tests.browser.desk import COARSE, Desk, open_desk, quick_forest, visit
from tests.browser.pictures import count

TABS = ("Fly", "World", "Why", "Layers", "Tune")
_FAINT = """
() => {
  const canvas = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
  const known = new Map();
  const rgba = css => {
    if (!known.has(css)) {
      canvas.clearRect(0, 0, 1, 1);
      canvas.fillStyle = css;
      canvas.fillRect(0, 0, 1, 1);
      known.set(css, [...canvas.getImageData(0, 0, 1, 1).data]);
    }
    return known.get(css);
  };
  const over = (below, top) => below.map((x, i) => x + (top[i] - x) * top[3] / 255);
  const light = color => [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => sum + w * (color[i] / 255) ** 2.2, 0.05);
  const faint = [], texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const text = texts.currentNode.data.trim(), element = texts.currentNode.parentElement;
    if (!text || element.matches("script, style") || !element.checkVisibility({visibilityProperty: true})) continue;
    const grounds = [], style = getComputedStyle(element);
    for (let e = element; e; e = e.parentElement) grounds.unshift(rgba(getComputedStyle(e).backgroundColor));
    const ground = grounds.reduce(over, [20, 25, 34, 255]);
    const ratio = light(over(ground, rgba(element instanceof SVGElement ? style.fill : style.color))) / light(ground);
    if (ratio > 1 / 2.6 && ratio < 2.6) faint.push(text);
  }
  return faint;
}
"""
"""Script that returns the texts whose contrast to what is below them is low."""


def use(desk: Desk, theme: str) -> None:
    if scheme(desk.page) != theme:
        desk.page.keyboard.press("l")
    desk.wait_for(lambda: scheme(desk.page) == theme, f"{theme} panels")


def scheme(page) -> str | None:
    return page.locator("html").get_attribute("data-mantine-color-scheme")


def test_every_text_can_be_read_in_both_themes_and_a_browser_remembers_theme_and_tabs(browser):
    with open_desk(browser, quick_forest(), ticks=30, size=(1280, 800), resolution=COARSE, layers=["drone"]) as desk:
        page = desk.page
        page.get_by_text("shorter is better").wait_for()
        desk.click("Curves")
        page.locator(".u-over").first.wait_for()
        desk.open_tab("Why")
        desk.checkbox("Explain the plan").click()
        page.get_by_role("button", name="5", exact=True).click()
        page.locator(".aero-term-table").wait_for()
        for theme in ("dark", "light"):
            use(desk, theme)
            for tab in TABS:
                desk.open_tab(tab)
                desk.wait_for(lambda: page.evaluate(_FAINT) == [], f"readable texts in {tab}, {theme}")

        desk.open_tab("World")
        desk.open_tab("Legend")
        kept = "['Fly', 'Planner'].map(group => localStorage.getItem('aero-tab ' + group))"
        desk.wait_for(lambda: page.evaluate(kept) == ["World", "Legend"], "the browser to remember the tabs")
        page.reload()
        page.get_by_role("button", name="Throw an obstacle").wait_for()
        page.get_by_text("partition", exact=True).first.wait_for()
        desk.wait_for(lambda: scheme(page) == "light", "light panels again")
        use(desk, "dark")

        other = visit(browser, desk.dashboard.url, resolution=COARSE)  # somebody else's browser
        other.get_by_role("button", name="Open path").wait_for()
        use(desk, "light")
        assert scheme(other) == "dark"
        other.close()
        assert desk.console == [] and desk.dashboard.failures == 0


def test_the_light_page_has_a_scene_for_paper_whose_legend_shows_the_same_colours(browser):
    with open_desk(browser, ticks=50, size=(1280, 800), layers=["rollouts", "guides", "trail", "ground"]) as desk:
        desk.open_tab("Legend")
        for theme, turn in (("light", palette.turned_over), ("dark", np.asarray)):
            use(desk, theme)
            chosen = turn(np.array(palette.CHOSEN))
            desk.wait_for(lambda chosen=chosen: count(desk.screenshot(), chosen) > 200, f"the chosen rollout, {theme}")
            picture = desk.settled_screenshot().astype(int)
            background = np.median(picture[:60].reshape(-1, 3), axis=0)
            assert background.min() > 245 if theme == "light" else background.max() < 40
            for color in (palette.GUIDE, palette.DRONE):
                assert count(picture, turn(np.array(color)), tolerance=40) > 100, theme
            grid = np.abs(picture[-200:] - np.median(picture[-200:].reshape(-1, 3), axis=0)).max(axis=-1)
            assert (grid > 20).sum() > 200, "lines on the ground"
            swatch = desk.page.locator("span.aero-scene").first.bounding_box()
            assert swatch is not None
            shown = desk.page.screenshot(clip={"x": swatch["x"] + 3, "y": swatch["y"] + 3, "width": 2, "height": 2})
            assert np.abs(iio.imread(shown)[..., :3].astype(int) - chosen).max() < 24, theme
        assert desk.console == [] and desk.dashboard.failures == 0
