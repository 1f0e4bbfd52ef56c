"""Videos and pictures of pages, drawn by a headless Chromium."""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aero_planner.plain_text import one_line
from aero_viz.dashboard.page_view import PageView
from aero_viz.dashboard.snapshot import launch_chromium
from aero_viz.errors import UserError
from aero_viz.extras import from_extra

if TYPE_CHECKING:
    from playwright.sync_api import Page

SIZE = (1280, 720)
"""Width and height of videos [pixels]."""
VIDEO_RATE = 25
"""Pictures per second of a video [Hz]."""
_TIMEOUT = 120_000.0
"""Longest wait for the browser [ms]: without a GPU, on a machine that plans at the same time, it is slow."""
_WORDS_MAX = 4096
"""Longest text of the encoder that is read [bytes]."""
_DRAWN = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
_BARE = """
.mantine-Notification-root, #aero details {display: none !important}
div:has(> .mantine-NumberInput-root) {position: fixed !important; top: -300px}
"""
"""Style sheet that hides what a video cannot use: notifications and the controls of the playback."""


def write_video(
    page: Path, path: Path, *, duration: float, size: tuple[int, int] = SIZE, report: Callable[[float], None]
) -> None:
    """Write the flight of a shared page as an MP4 file.

    Args:
        page: file of the page.
        path: file to write.
        duration: duration of the flight [s].
        size: width and height [pixels].
        report: called with the time in the flight [s] after each picture.

    Raises:
        UserError: Chromium, Playwright or imageio-ffmpeg is missing, or the video cannot be encoded.
    """
    with _video_writer(path) as write, _opened(page.resolve().as_uri(), size) as opened:
        field = opened.locator(".mantine-NumberInput-input").first
        field.wait_for()
        opened.keyboard.press("Space")  # pause
        opened.add_style_tag(content=_BARE)
        for number in range(int(duration * VIDEO_RATE) + 1):
            time = number / VIDEO_RATE
            field.fill(f"{time + 1e-3:.3f}", force=True)
            opened.evaluate("time => window.aeroShow(time)", time)
            opened.evaluate(_DRAWN)
            write(opened.screenshot(type="jpeg", quality=92))
            report(time)


def page_picture(url: str, view: PageView) -> bytes:
    """Return a picture of the page at an address as PNG, with its panels.

    Args:
        url: address.
        view: what the page shows.

    Raises:
        UserError: Chromium or Playwright is missing.
    """
    with _opened(url, view.size, view.storage) as page:
        if view.is_ready:
            page.wait_for_function(view.is_ready)
        else:
            page.get_by_text("shorter is better").first.wait_for()
        page.add_style_tag(content=".mantine-Notification-root {display: none !important}")
        previous = b""
        for _ in range(20):  # the page builds its nodes over several frames
            page.wait_for_timeout(250)
            page.evaluate(_DRAWN)
            picture = page.screenshot(type="png")
            if picture == previous:
                break
            previous = picture
        return previous


@contextlib.contextmanager
def _opened(url: str, size: tuple[int, int], storage: Mapping[str, str] | None = None) -> Iterator[Page]:
    with launch_chromium() as browser:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(_TIMEOUT)
        if storage:
            page.add_init_script(
                f"Object.entries({json.dumps(storage)}).forEach(item => localStorage.setItem(...item))"
            )
        page.goto(url)
        yield page


@contextlib.contextmanager
def _video_writer(path: Path) -> Iterator[Callable[[bytes], Any]]:
    """Yield a function that appends a JPEG picture to a video.

    imageio-ffmpeg's own writer does not say whether the encoder failed, as on a full disk.
    """
    with from_extra("video", "Videos"):
        from imageio_ffmpeg import get_ffmpeg_exe
    pictures = ["-f", "image2pipe", "-c:v", "mjpeg", "-framerate", str(VIDEO_RATE), "-i", "-"]
    coding = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"]
    command = [get_ffmpeg_exe(), "-loglevel", "error", "-y", *pictures, *coding, str(path.absolute())]
    with (
        tempfile.TemporaryFile() as errors,
        subprocess.Popen(command, bufsize=0, stdin=subprocess.PIPE, stderr=errors) as encoder,
    ):
        assert encoder.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # the encoder has ended
                yield encoder.stdin.write
            encoder.stdin.close()
        except BaseException:
            encoder.kill()
            raise
        if encoder.wait():
            errors.seek(0)
            reason = errors.read(_WORDS_MAX).decode(errors="replace").splitlines()
            raise UserError(f"The video cannot be encoded: {one_line(reason[0] if reason else encoder.returncode)}.")
