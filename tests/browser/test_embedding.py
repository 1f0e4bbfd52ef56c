"""Another web page shows ours in a frame if its origin was named, as a notebook does."""

import functools
import http.server
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from aero_viz.dashboard import LocalServer


@pytest.fixture
def notebook(tmp_path: Path) -> Iterator[str]:
    """Origin of a server whose folder is `tmp_path`."""
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}"
        server.shutdown()


@pytest.mark.parametrize("named", [True, False])
def test_a_page_shows_ours_in_a_frame_if_it_was_named(browser: Browser, notebook: str, tmp_path: Path, named: bool):
    server = LocalServer(port=0, embedders=[notebook] if named else ["http://localhost:1"])
    server.gui.add_markdown("The page in a cell.")
    (tmp_path / "cell.html").write_text(f'<iframe src="{server.url}" width="900" height="600"></iframe>')
    with closing(browser.new_page()) as page:
        messages: list[str] = []
        page.on("console", lambda message: messages.append(message.text))
        page.goto(f"{notebook}/cell.html")
        if named:
            page.frame_locator("iframe").get_by_text("The page in a cell.").wait_for()
        else:
            assert any("frame-ancestors" in message for message in messages), messages
    server.stop()
