"""Icons of buttons and tabs."""

import pytest
import viser

from aero_viz.dashboard.icons import share_archive
from aero_viz.dashboard.server import LocalServer
from tests.dashboard.page_client import join, read_until


def test_all_icons_come_from_one_open_archive(server: LocalServer, monkeypatch: pytest.MonkeyPatch):
    share_archive()
    server.gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)

    def refuse(*_: object) -> None:
        raise AssertionError("the archive is opened again")

    monkeypatch.setattr("zipfile.ZipFile", refuse)
    server.gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
    server.gui.add_tab_group().add_tab("World", viser.Icon.TREES)
    with join(server) as client:
        heard = read_until(client, "icon-tabler-trees")
    assert "icon-tabler-player-play" in heard and "icon-tabler-player-pause" in heard
