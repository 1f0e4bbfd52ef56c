"""A session, its dashboard and the page that shows it, with the actions of a user."""

import contextlib
import io
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from numpy.typing import ArrayLike, NDArray
from playwright.sync_api import Browser, Locator, Page
from playwright.sync_api import TimeoutError as PlaywrightTimeout
from viser import CameraHandle

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW, orientation
from aero_viz.dashboard.share import FlightFiles
from aero_viz.evaluation.tune import StoredStudy
from aero_viz.flight import FlightSource
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.scenes import SCENES, scene
from aero_viz.sensors import LidarModel
from aero_viz.session import Frame, Session
from aero_viz.session.source import Conditions, Opener, Source
from tests.browser.pictures import Image, differing, project, rollouts_drawn

LEFT, RIGHT = 330, 355
"""Columns at either side of the page that panels cover [pixels]."""
COARSE = 0.25
"""Resolution of a page of whose scene no test takes a screenshot. It is drawn in a third of the time."""
TIMEOUT = 90.0
"""Longest wait for anything [s]. It is only reached when a test fails, also on a machine that is busy."""
# The page of viser sends one message per 50 ms, the newest: a click in less time would replace a number. Its timers are
# late on a busy machine, which a person does not outrun.
_SENT = "() => new Promise((sent) => setTimeout(sent, 60))"
"""Script that waits until the page has sent what was typed."""


@dataclass
class Desk:
    """A paused session, its dashboard, and a page that shows it."""

    session: Session
    dashboard: Dashboard
    page: Page
    console: list[str] = field(default_factory=list)
    restored: Frame | None = None
    """Frame that was shown when the desk was restored last."""

    @property
    def camera(self) -> CameraHandle:
        """Camera of the first visitor."""
        return next(iter(self.dashboard.server.get_clients().values())).camera

    def wait_for(self, condition: Callable[[], bool], description: str) -> None:
        """Wait until `condition` holds."""
        deadline = time.monotonic() + TIMEOUT
        while not condition():
            assert time.monotonic() < deadline, f"waited {TIMEOUT} s for {description}"
            self.page.wait_for_timeout(30)

    def known(self, config: PlannerConfig) -> PlannerConfig:
        """The configuration with what the planner knows about the flight on the page."""
        assert self.session.frame is not None
        return config_for_flight(config, self.session.frame.source)

    def restore(self) -> None:
        """Fly the first 10 ticks through the forest again, and show the drone alone in the first view of the page.

        The fields that say what to open next keep what was typed into them.
        """
        session, visitors = self.session, self.dashboard.server.get_clients
        self.wait_for(lambda: len(visitors()) == 1, "the visitors of the test before to leave")
        if self.page.url != with_resolution(f"{self.dashboard.url}/", COARSE):
            self._reload()
        self._settle()
        session.step(0).result()  # pauses, after all that the test before has caused
        session.set_speed(1.0)
        if self.restored is None or session.frame is not self.restored:
            session.configure(PlannerConfig())
            session.set_source(quick_forest()).result()
            session.step(9).result()
            assert session.frame is not None and session.frame.index == 9 and session.frame.config == PlannerConfig()
            self.restored = session.frame
        self.dashboard.show_only(["drone"])
        self.click("follow")
        self.dismiss_all()

    def _settle(self) -> None:
        """Open the first tab, and wait until nothing that was done on the page still has to reach the session."""
        self.open_tab("Fly")
        # A source is on the page before the thread that has opened it is done: the planner's facts and Play follow.
        self.page.get_by_role("button", name="Cancel opening").wait_for(state="hidden")
        self.page.evaluate(_SENT)
        is_last = threading.Event()
        button = self.dashboard.server.gui.add_button("Last click", order=-1)
        button.on_click(lambda _: is_last.set())
        self.click("Last click")
        self.wait_for(is_last.is_set, "the last click, which is handled after all before it")
        button.remove()

    def _reload(self) -> None:
        """Open the page again, without what a test has added to its address."""
        visitors = self.dashboard.server.get_clients
        before = set(visitors())
        self.page.goto(with_resolution(self.dashboard.url, COARSE))
        self.wait_for(lambda: len(visitors()) == 1 and before.isdisjoint(visitors()), "the page to connect again")

    def click(self, name: str) -> None:
        """Click the button with this name."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def control(self, label: str) -> Locator:
        """The row of the panel with this label."""
        exact = self.page.locator("label", has_text=re.compile(f"^{re.escape(label)}$"))
        return exact.locator("xpath=ancestor::div[contains(@class, 'Flex')][1]")

    def parameter(self, path: str) -> Locator:
        """The row of the panel with a parameter's number field, checkbox or dropdown."""
        return self.control(PlannerConfig.find(path).title)

    def slider(self, path: str) -> Locator:
        """The slider below a parameter's number field."""
        return self.parameter(path).locator("xpath=../following-sibling::*[1]")

    def enter(self, field: Locator, value: object) -> None:
        """Replace what a field holds, and press Enter."""
        field.fill(str(value))
        field.press("Enter")

    def type_number(self, field: Locator, number: float) -> None:
        """Replace what a field holds, key by key, and leave the cursor in it."""
        field.click(click_count=3)
        field.press_sequentially(f"{number:g}")
        self.page.evaluate(_SENT)

    def choose(self, label: str, option: str) -> None:
        """Choose an option of a dropdown; a change that arrives meanwhile closes its list, and it is opened again."""
        choice = self.page.get_by_role("option", name=option, exact=True)

        def chosen() -> bool:
            if not choice.is_visible():
                self.control(label).locator("input").first.click()
            with contextlib.suppress(PlaywrightTimeout):
                choice.click(timeout=2000)
                return True
            return False

        self.wait_for(chosen, f"{option} to be on offer")

    def download(self, button: str, folder: Path) -> Path:
        """Click a button and save the file that it offers."""
        with self.page.expect_download() as download:
            self.click(button)
        download.value.save_as(path := folder / download.value.suggested_filename)
        return path

    def open_tab(self, name: str) -> None:
        """Open a tab of the control panel."""
        self.page.get_by_role("tab", name=name).click()

    def open_folder(self, name: str, content: str) -> None:
        """Open a folder of the panel unless `content`, the text of one of its controls, is visible."""
        control = self.page.get_by_text(content, exact=True).first
        if not control.is_visible():
            self.page.get_by_text(name, exact=True).first.click()
            control.wait_for()

    def checkbox(self, label: str) -> Locator:
        """The checkbox with this label."""
        return self.control(label).get_by_role("checkbox")

    def refusal(self, words: str) -> Locator:
        """The error notification that contains these words."""
        errors = self.page.locator(".mantine-Notification-root", has_text="Error")
        return errors.filter(has_text=words)

    def dismiss(self, notification: Locator) -> None:
        """Close a notification, so that a later one is not mistaken for it."""
        notification.get_by_role("button").click()
        notification.wait_for(state="detached")

    def dismiss_all(self) -> None:
        """Close all notifications, also those that never leave by themselves."""
        self.page.evaluate("document.querySelectorAll('.mantine-Notification-root button').forEach(b => b.click())")
        self.wait_for(lambda: self.page.locator(".mantine-Notification-root").count() == 0, "no notifications")

    def screenshot(self) -> Image:
        """The part of the page between the panels, shape [height, width, 3]."""
        window = self.page.viewport_size
        assert window is not None
        width, height = window["width"] - LEFT - RIGHT, window["height"]
        image = self.page.screenshot(clip={"x": LEFT, "y": 0, "width": width, "height": height})
        return iio.imread(io.BytesIO(image))[..., :3]

    def settled_screenshot(self) -> Image:
        """The same, once the page has drawn everything that was sent and an update no longer changes it."""

        def updated() -> Image:
            self.render((0.0, 0.0, 5.0), (1.0, 0.0, 5.0), width=16, height=16)  # the answer follows all that was sent
            self.page.wait_for_timeout(200)
            return self.screenshot()

        images = [updated()]

        def is_settled() -> bool:
            images.append(updated())
            return differing(images[-1], images[-2]) == 0

        self.wait_for(is_settled, "a picture that no longer changes")
        return images[-1]

    def settled(self, read: Callable[[], ArrayLike], description: str) -> NDArray[np.float64]:
        """Return what `read` returns, once it is the same for a second."""
        values = [np.asarray(read())]

        def is_settled() -> bool:
            self.page.wait_for_timeout(1000)
            values.append(np.asarray(read()))
            return np.array_equal(values[-1], values[-2])

        self.wait_for(is_settled, description)
        return values[-1]

    def place_on_page(self, point: ArrayLike) -> tuple[float, float]:
        """Position of a point of the world on the page, from the left and from the top [pixels]."""
        canvas = self.page.locator("canvas").first.bounding_box()
        assert canvas is not None
        shape = (round(canvas["height"]), round(canvas["width"]))
        row, column = project(np.atleast_2d(point), self.camera.position, self.camera.look_at, shape)[0]
        return canvas["x"] + float(column), canvas["y"] + float(row)

    def drag(self, start: tuple[float, float], by: tuple[float, float]) -> None:
        """Press the mouse button at `start`, move the mouse in steps, and release the button."""
        mouse = self.page.mouse
        mouse.move(*start)
        self.page.wait_for_timeout(300)
        for _ in range(3):  # the page looks for an object under the mouse once per picture
            self.page.evaluate("() => new Promise((drawn) => requestAnimationFrame(() => drawn(null)))")
        mouse.down()
        for share in np.linspace(0.0, 1.0, 9)[1:]:
            mouse.move(start[0] + share * by[0], start[1] + share * by[1])
            self.page.wait_for_timeout(60)
        mouse.up()

    def wait_for_rollouts(self, position: ArrayLike, look_at: ArrayLike) -> None:
        """Wait until all rollouts are drawn in their colours."""
        plan = self.session.frame.plan  # type: ignore[union-attr]

        def are_drawn() -> bool:
            found = rollouts_drawn(self.render(position, look_at), plan, position, look_at)
            return found.min() > 0.2  # the share of each rollout's vertices that have its colour

        self.wait_for(are_drawn, "all rollouts in their colours")

    def render(self, position: ArrayLike, look_at: ArrayLike, *, width: int = 640, height: int = 600) -> Image:
        """Render the scene from `position`, shape [height, width, 4]; alpha is 0 where nothing is drawn."""
        assert self.dashboard.drain()
        position, look_at = np.asarray(position, dtype=np.float64), np.asarray(look_at, dtype=np.float64)
        attitude = orientation(position, look_at)
        return self.camera.client.get_render(
            height, width, wxyz=attitude, position=position, fov=FIELD_OF_VIEW, transport_format="png", timeout=TIMEOUT
        )


def quick_forest(*, count: int | None = None) -> FlightSource:
    """Return a flight through the forest with a tenth of the points of a Mid-360, which takes half of the time.

    Args:
        count: number of trees; fewer are drawn faster. None is the forest's own.
    """
    lidar = LidarModel("sparse", points_per_sweep=2000)
    return FlightSource(scene("forest", seed=0, count=count), lidar=lidar)


def visit(browser: Browser, url: str, *, size: tuple[int, int] = (1000, 700), resolution: float = 1.0) -> Page:
    """Open a page in a browser profile of its own, which closes with it."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(1e3 * TIMEOUT)
    page.goto(with_resolution(url, resolution))
    return page


def with_resolution(url: str, resolution: float = 1.0) -> str:
    """Return the address of the page with a fixed resolution of the scene [points per pixel of the page].

    Without it, viser lowers the resolution of a page that is drawn slowly.
    """
    return f"{url}{'&' if '?' in url else '?'}fixedDpr={resolution:g}"


@contextlib.contextmanager
def open_desk(
    browser: Browser,
    source: Source | None = None,
    *,
    ticks: int,
    config: PlannerConfig | None = None,
    size: tuple[int, int] = (1000, 600),
    resolution: float = 1.0,
    layers: Sequence[str] | None = None,
    opener: Opener = open_source,
    opened: str = "",
    seed: int = 0,
    study: StoredStudy | None = None,
    script: str = "",
) -> Iterator[Desk]:
    """Open the page of a paused session.

    Args:
        browser: browser to open it in.
        source: source to show; None is the forest.
        ticks: number of ticks before the page opens.
        config: configuration of the planner; None is the default.
        size: width and height of the page.
        resolution: resolution of the scene; `COARSE` is drawn quickly.
        layers: names of the visible layers; None shows those that are on by default.
        opener: opens other sources.
        opened: name of the source for the opener; by default that of the forest.
        seed: seed of the source, as the page shows it.
        study: study to show.
        script: JavaScript that runs before the page does.
    """
    session = Session(source or FlightSource(scene("forest", seed=0)), config=config)
    for _ in range(ticks):
        session.tick()
    session.start(play=False)
    choices = [(f"{name}: {kind.description}", name) for name, kind in SCENES.items()]
    dashboard = Dashboard(
        session,
        port=0,
        open_source=opener,
        opened=opened,
        seed=seed,
        choices=choices,
        folders=["/"],
        conditions=Conditions(),
        files=FlightFiles(),
        study=study,
    )
    dashboard.show_only(layers)
    context = browser.new_context(viewport={"width": size[0], "height": size[1]}, accept_downloads=True)
    context.set_default_timeout(1e3 * TIMEOUT)
    page = context.new_page()
    page.add_init_script(script)
    desk = Desk(session, dashboard, page)
    page.on("console", lambda message: desk.console.append(message.text) if message.type == "error" else None)
    page.on("pageerror", lambda error: desk.console.append(str(error)))
    try:
        page.goto(with_resolution(dashboard.url, resolution))
        desk.wait_for(lambda: bool(dashboard.server.get_clients()), "the page to connect")
        yield desk
    finally:
        context.close()
        dashboard.close()
        session.close()
