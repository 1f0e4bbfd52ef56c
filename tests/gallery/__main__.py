"""Take a picture of every view of the page: `make gallery`, or `make gallery ARGS="why compare --folder pictures"`."""

import argparse
import html
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source, shipped_recordings
from aero_viz.dashboard.snapshot import launch_chromium
from aero_viz.flight.known_drone import config_for_flight
from tests.browser.desk import Desk, open_desk

ROOT = Path(__file__).resolve().parents[2]
STATIC = {"dashboard": 1120, "failure": 880, "arrived": 880}
"""Views that the README and the docs show, from static/, with their widths there [pixels]."""
RECORDING = shipped_recordings()["forest_mid360"][0]


def _nothing(desk: Desk) -> None:
    pass


@dataclass(frozen=True)
class View:
    """A picture of the page.

    Attributes:
        caption: what it shows.
        source: scene or recording.
        seed: seed of the scene.
        seconds: time in it [s].
        act: what a user does before the picture is taken.
        size: width and height of the page [pixels].
        layers: names of the visible layers; None shows those that are on by default.
        config: configuration of the planner; None is the default.
    """

    caption: str
    source: str = "forest"
    seconds: float = 1.6
    act: Callable[[Desk], None] = _nothing
    size: tuple[int, int] = (1600, 900)
    layers: Sequence[str] | None = None
    config: PlannerConfig | None = None
    seed: int = 0


def _tab(name: str) -> Callable[[Desk], None]:
    return lambda desk: desk.open_tab(name)


def _top(desk: Desk) -> None:
    desk.click("top")


def _legend(desk: Desk) -> None:
    desk.open_tab("Layers")
    desk.open_tab("Legend")


def _explain(desk: Desk) -> None:
    desk.open_tab("Why")
    desk.checkbox("Explain the plan").click()
    desk.page.get_by_role("button", name="5", exact=True).click()
    desk.page.locator(".aero-term-table").wait_for()


def _compare(desk: Desk) -> None:
    desk.open_tab("Tune")
    desk.click("Compare: pin as A")
    desk.session.configure({"vehicle.speed_limit": 3.0, "costs.q_track": 8.0})
    desk.page.get_by_text("speed at its end [m/s]").wait_for()


def _curves(desk: Desk) -> None:
    desk.session.step(100).result()
    desk.click("Curves")
    desk.page.locator(".u-over").first.wait_for()


def _end(desk: Desk) -> None:
    """Fly on to the end of the flight, and show its report."""
    desk.open_tab("Why")
    _fly(desk)
    desk.page.locator(".aero-report").wait_for()


def _arrive(desk: Desk) -> None:
    """Fly on to the end of the flight, and show the configuration."""
    desk.open_tab("Tune")
    _fly(desk)


def _share(desk: Desk) -> None:
    """Fly on to the end of the flight, and show how to hand it on."""
    _fly(desk)
    desk.open_tab("Fly")
    desk.open_folder("Share", "Log")
    desk.page.get_by_role("button", name="Log", exact=True).scroll_into_view_if_needed()


def _fly(desk: Desk) -> None:
    while desk.session.frame is None or desk.session.frame.outcome is None:
        desk.session.step(25).result()


_NO_CLOUD = ["rollouts", "guides", "anchors", "drone", "trail", "goal", "obstacles", "ground"]
VIEWS = {
    "dashboard": View("The dashboard during a flight through the forest", seconds=2.0),
    "top": View("The same from above", act=_top),
    "layers": View("Cells of the partition, anchors and guides, with their legend", act=_legend,
                   layers=["coarse_cells", "fine_cells", "anchors", "guides", "drone"]),
    "hidden": View("What is measured and continued, and what is hidden behind it", act=_legend,
                   layers=["fine_cells", "occluded_space", "rollouts", "drone", "ground"]),
    "curves": View("Curves of every tick with the events of the flight", seconds=0.2, act=_curves),
    "why": View("Why an instance lost: terms by step, samples and controls", act=_explain),
    "tune": View("Parameters with search, presets and what differs from them", act=_tab("Tune")),
    "compare": View("Two configurations on the same tick", act=_compare),
    "world": View("Obstacles that can be added, moved and thrown in the way", act=_tab("World")),
    "inclines": View("Leaning trunks", "inclines", 2.0),
    "verticals": View("A dense field of trunks", "verticals", 2.0),
    "wires": View("Taut wires between posts", "wires", 2.0),
    "branches": View("Bare trees with thin branches", "branches", 2.0),
    "crowns": View("Crowns with and without a trunk", "crowns", 2.0),
    "blocks": View("A street between city blocks", "blocks", 2.0),
    "windows": View("A wall with windows", "windows", 0.8, seed=1),
    "hall": View("A hall with pillars and beams", "hall", 2.0),
    "slope": View("Trees on rising ground", "slope", 2.0),
    "mixture": View("Obstacles of many kinds", "mixture", 2.0),
    "room": View("A room with a trap, opened for the camera", "double_wall_trap", 1.0),
    "failure": View("Why a flight failed", "double_wall_trap", 0.2, _end, size=(1280, 800),
                    layers=_NO_CLOUD, config=PlannerConfig.preset("paper"), seed=1),
    "arrived": View("The same with the default configuration", "double_wall_trap", 0.2, _arrive, size=(1280, 800),
                    layers=_NO_CLOUD, seed=1),
    "share": View("What can be handed on", "double_wall_trap", 0.2, _share, size=(1280, 800), layers=_NO_CLOUD, seed=1),
    "recording": View("A recorded flight", str(RECORDING), 2.0),
    "small": View("A window of 1280 x 720", size=(1280, 720)),
    "portrait": View("A window of 800 x 1200", size=(800, 1200)),
}  # fmt: skip
"""Views by the names of their files."""


def main() -> int:
    """Take the pictures, and write a page that shows all of them."""
    parser = argparse.ArgumentParser(prog="gallery", description=__doc__)
    parser.add_argument("views", nargs="*", help=f"names of views: {', '.join(VIEWS)}; all by default")
    parser.add_argument("--folder", type=Path, default=Path("build/gallery"), help="where the pictures are written")
    parser.add_argument(
        "--static", action="store_true", help=f"renew the pictures of README and docs: {', '.join(STATIC)}"
    )
    options = parser.parse_args()
    if unknown := sorted(set(options.views) - set(VIEWS)):
        parser.error(f"there is no view {', '.join(unknown)}; there are {', '.join(VIEWS)}")
    options.folder.mkdir(parents=True, exist_ok=True)
    names = options.views or list(VIEWS)
    for name in names:
        take(VIEWS[name], options.folder / f"{name}.png")
        print(options.folder / f"{name}.png", flush=True)
    write_page(options.folder, [name for name in VIEWS if (options.folder / f"{name}.png").exists()])
    for name in set(names) & set(STATIC) if options.static else ():
        picture, width = Image.open(options.folder / f"{name}.png").convert("RGB"), STATIC[name]
        size = (width, width * picture.height // picture.width)
        picture.resize(size).save(ROOT / "static" / f"{name}.webp", quality=33, method=6)
    return 0


def take(view: View, path: Path) -> None:
    """Write the picture of a view as PNG."""
    source = open_source(view.source, seed=view.seed)
    options: dict[str, Any] = {
        "ticks": round(view.seconds / source.info.period),
        "config": config_for_flight(view.config or PlannerConfig(), source.info),
        "opened": view.source,
        "seed": view.seed,
    }
    with (
        launch_chromium() as browser,
        open_desk(browser, source, size=view.size, layers=view.layers, **options) as desk,
    ):
        desk.page.get_by_text("shorter is better").wait_for()
        view.act(desk)
        for button in desk.page.locator(".mantine-Notification-closeButton").all():
            button.click()
        desk.settled_screenshot()
        desk.page.screenshot(path=path)
        if desk.console:
            raise SystemExit(f"{path.stem}: the page reports {desk.console[0]}")


def write_page(folder: Path, names: Sequence[str]) -> None:
    """Write an HTML page with the pictures of these views."""
    figures = "".join(
        f'<figure><a href="{name}.png"><img src="{name}.png" width="100%"></a>'
        f"<figcaption>{html.escape(VIEWS[name].caption)}</figcaption></figure>"
        for name in names
    )
    style = "body{background:#0c1018;color:#ccc;font:15px sans-serif;display:grid;grid-template-columns:1fr 1fr}"
    (folder / "index.html").write_text(f"<!doctype html><title>AERO-Viz</title><style>{style}</style>{figures}\n")


if __name__ == "__main__":
    sys.exit(main())
