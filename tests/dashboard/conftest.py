from collections.abc import Iterator

import pytest

from aero_viz.dashboard.server import LocalServer


@pytest.fixture
def server() -> Iterator[LocalServer]:
    """A server of the page without a session."""
    server = LocalServer(port=0)
    yield server
    server.stop()
