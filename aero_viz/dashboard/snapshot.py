"""Pictures of any source at any time, rendered in a headless Chromium."""

from __future__ import annotations

import base64
import contextlib
import time as clock
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner.config import DroneConfig
from aero_planner.output_files import whole_file
from aero_viz.browser import CHROMIUM_FLAGS, find_chromium
from aero_viz.dashboard import Dashboard, palette
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW, VIEWS, Viewpoints, orientation
from aero_viz.dashboard.scene_style import sky, style_scene
from aero_viz.errors import UserError
from aero_viz.extras import from_extra
from aero_viz.session import Session
from aero_viz.session.source import Source

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@contextlib.contextmanager
def launch_chromium(*flags: str) -> Iterator[Browser]:
    """Run a headless Chromium without a GPU.

    Args:
        flags: further flags of the program.

    Raises:
        UserError: Chromium or Playwright is missing, or Chromium does not start.
    """
    program = find_chromium()
    with from_extra("pictures", "Pictures"):
        from playwright.sync_api import Error, sync_playwright
    with sync_playwright() as playwright:
        try:
            browser = playwright.chromium.launch(executable_path=program, args=[*CHROMIUM_FLAGS, *flags])
        except Error as error:
            reason = str(error).splitlines()[0]
            raise UserError(f"{program} does not start: {reason}") from error
        try:
            yield browser
        finally:
            browser.close()


def snapshot(
    source: Source,
    *,
    path: str | Path | None = None,
    time: float = 0.0,
    config: DroneConfig | None = None,
    camera: str | tuple[ArrayLike, ArrayLike] = "follow",
    size: tuple[int, int] = (1280, 800),
    layers: Sequence[str] | None = None,
    legend: bool = False,
    light: bool = False,
    seed: int = 0,
    device: str = "cpu",
) -> NDArray[np.uint8]:
    """Render the scene of `source` at `time`. Equal arguments give equal pictures, up to the edges of lines.

    Args:
        source: source to show; closed afterwards.
        path: PNG file to write; None writes none.
        time: source time [s]. A flight is flown up to it, a recording seeks to it.
        config: configuration of the planner; None is the default.
        camera: "follow", "top" or "side", or position and look-at [m], each shape [3], world frame.
        size: width and height of the picture.
        layers: names of the layers to show, see `Dashboard.layers`; None shows those that are on by default.
        legend: explain the colours in a corner of the picture.
        light: draw the scene on white, for paper.
        seed: seed of the planner's noise.
        device: Warp device of the planner.

    Returns:
        The picture, shape [height, width, 3].

    Raises:
        UserError: there is no browser, a layer or camera is unknown, the time is beyond the end, the size is out of
            range, or the file cannot be written.
    """
    if not all(16 <= length <= 8192 for length in size):
        source.close()
        raise UserError(f"The size is {size[0]} x {size[1]} pixels; width and height must be in [16, 8192].")
    if path is not None and (reason := _path_problem(Path(path))):  # before the flight
        source.close()
        raise UserError(f"The picture {path} cannot be written: {reason}.")
    with contextlib.ExitStack() as stack:
        session = Session(source, config=config, device=device, seed=seed)
        stack.callback(session.close)
        _go_to(session, time)
        dashboard = Dashboard(session, port=0, panels=False)
        stack.callback(dashboard.close)
        dashboard.show_only(layers)
        style_scene(dashboard.server.scene, light=light)
        pose = _camera(session, camera)
        dashboard.eye = np.asarray(pose[0], dtype=np.float64)
        # Playwright needs a thread without an event loop; that of a notebook has one.
        with ThreadPoolExecutor(1) as outside:
            image = outside.submit(_render, dashboard, pose, size, light=light).result()
            if legend:
                image = outside.submit(_with_legend, image, dashboard, light=light).result()
    if path is not None:
        _write(image, Path(path))
    return image


def _go_to(session: Session, time: float) -> None:
    """Go to the tick at or before `time` [s], as fast as the machine can."""
    if not np.isfinite(time) or time < 0.0:
        raise UserError(f"The time is {time:g} s; it must be a finite number that is not negative.")
    frame, source = session.tick(), session.source
    if source.times is not None:
        if time > source.times[-1] + source.period:
            raise UserError(f"{source.name} ends at {source.times[-1]:.2f} s; give an earlier time.")
        session.seek(time).result()
        return
    tolerance = 0.5 * source.period
    while frame.time < time - tolerance:
        frame = session.tick()
        if frame.outcome is not None and frame.time < time - tolerance:
            reason = "" if frame.explanation is None else f" {frame.explanation}"
            raise UserError(
                f"{source.name} ends at {frame.time:.2f} s ({frame.outcome}); give an earlier time.{reason}"
            )


def _camera(session: Session, camera: str | tuple[ArrayLike, ArrayLike]) -> tuple[Any, Any]:
    frame = session.frame
    assert frame is not None
    if isinstance(camera, str):
        if camera not in VIEWS:
            raise UserError(f"Unknown camera {camera!r}; known: {', '.join(VIEWS)}, or a position and a look-at.")
        return Viewpoints().find(camera, frame)
    position, look_at = (np.asarray(point, dtype=np.float64) for point in camera)
    if position.shape != (3,) or look_at.shape != (3,) or np.allclose(position, look_at):
        raise UserError("The camera must be a position and a look-at: two different points of three numbers each.")
    return position, look_at


def _render(dashboard: Dashboard, pose: tuple[Any, Any], size: tuple[int, int], *, light: bool) -> NDArray[np.uint8]:
    """Open the page and render its scene, without panels, for a camera position and look-at point."""
    with launch_chromium() as browser:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(dashboard.url)
        client = _first_client(dashboard, page)
        assert dashboard.drain(), "the frame was not sent"
        position, look_at = pose
        view: dict[str, Any] = {"wxyz": orientation(position, look_at), "position": position, "fov": FIELD_OF_VIEW}
        view |= {"transport_format": "png", "timeout": 60.0}
        previous = None
        with dashboard.server.rendering(client):
            for _ in range(20):  # the page builds its nodes over several frames
                preview = client.get_render(size[1] // 4, size[0] // 4, **view)
                if previous is not None and np.array_equal(preview, previous):
                    break
                previous = preview
                page.wait_for_timeout(100)
            picture = client.get_render(size[1], size[0], **view)
        # The picture is transparent where nothing was drawn.
        cover = picture[..., 3:].astype(np.float32) / 255.0
        below = sky(size[1], size[0], light=light)
        picture = (cover * picture[..., :3] + (1.0 - cover) * below).round().astype(np.uint8)
    return palette.turned_over(picture) if light else picture


def _with_legend(picture: NDArray[np.uint8], dashboard: Dashboard, *, light: bool) -> NDArray[np.uint8]:
    """Return the picture with the legend of the visible layers in its lower left corner."""
    import imageio.v3 as iio

    url = base64.b64encode(iio.imwrite("<bytes>", picture, extension=".png")).decode()
    style = "position:fixed;left:16px;bottom:16px;width:270px;padding:10px;border-radius:8px;font-family:sans-serif;"
    ink, ground = ((30, 34, 42), (255, 255, 255)) if light else ((223, 229, 238), (18, 23, 32))
    style += f"color:{palette.css(ink)};background:{palette.css(ground, 0.82)}"
    swatches = f"<style>.aero-scene{{filter:{palette.TURNED_OVER}}}</style>" if light else ""
    # A second browser, because on a busy machine Chromium may fail to capture a page while another one draws.
    with launch_chromium() as browser:
        page = browser.new_page(viewport={"width": picture.shape[1], "height": picture.shape[0]})
        page.set_content(
            f'{swatches}<body style="margin:0"><img src="data:image/png;base64,{url}" style="display:block">'
            f'<div style="{style}">{markup.legend(dashboard.legend())}</div>'
        )
        return iio.imread(page.screenshot(timeout=60_000))[..., :3]


def _first_client(dashboard: Dashboard, page: Page) -> Any:
    deadline = clock.monotonic() + 60.0
    while not dashboard.server.get_clients():
        if clock.monotonic() > deadline:
            raise UserError("The browser did not open the page within 60 s; run `aero-viz doctor` to check it.")
        page.wait_for_timeout(50)
    return next(iter(dashboard.server.get_clients().values()))


def _path_problem(path: Path) -> str:
    """Return the reason why no picture can be written to a path; empty if there is none."""
    if path.is_dir():
        return f"it is a folder; give the name of a file, such as {path / 'picture.png'}"
    if path.suffix.lower() != ".png":
        return f"pictures are PNG files; name it {path.with_suffix('.png')}"
    return "" if path.parent.is_dir() else f"there is no folder {path.parent}; create it first"


def _write(image: NDArray[np.uint8], path: Path) -> None:
    import imageio.v3 as iio

    # Encoded in memory: on a full disk, imageio would fail a second time when it closes the file.
    content = iio.imwrite("<bytes>", image, extension=".png")
    try:
        with whole_file(path, alone=True) as partial:
            partial.write_bytes(content)
    except OSError as error:
        raise UserError(f"The picture {path} cannot be written: {error.strerror or error}.") from error
