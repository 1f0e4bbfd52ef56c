from collections.abc import Iterator

import pytest
from small_source import small_config, small_source

from aero_viz.dashboard.server import LocalServer
from aero_viz.session import Session
from tests.dashboard.page_client import CAMERA, join, send, wait_for


@pytest.fixture
def server() -> Iterator[LocalServer]:
    """A server of the page without a session."""
    server = LocalServer(port=0)
    yield server
    server.stop()


@pytest.fixture
def client(server: LocalServer):
    """A client of the server that has sent its camera."""
    with join(server) as client:
        send(client, **CAMERA)
        wait_for(server.get_clients, "the client")
        yield client


@pytest.fixture
def public() -> Iterator[LocalServer]:
    """A server that other machines can reach."""
    server = LocalServer(host="0.0.0.0", port=0)
    yield server
    server.stop()


@pytest.fixture
def session() -> Iterator[Session]:
    """A session after its first tick."""
    session = Session(small_source(), config=small_config())
    session.tick()
    yield session
    session.close()
