"""What all panels share."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import viser

from aero_viz.dashboard.layers import Change, Layer
from aero_viz.dashboard.server import LocalServer, notify
from aero_viz.errors import UserError
from aero_viz.session.broadcast import Steerable
from aero_viz.session.frame import Frame
from aero_viz.session.source import Source

__all__ = ["Page", "Panel"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Page:
    """What panels act on."""

    server: LocalServer
    session: Steerable
    layers: Mapping[str, Layer]
    refresh: Callable[[], None]
    """Show the newest frame again: after a change that brings no frame of its own."""

    def attempt(self, action: Callable[[], Any], client: viser.ClientHandle | None = None) -> bool:
        """Run `action`; a user's mistake becomes a notification. Returns whether it went well."""
        try:
            action()
        except (UserError, ValueError, OSError) as error:
            notify(self.server, str(error), level="error", client=client)
            return False
        except Exception as error:
            _log.exception("an action of the page failed")
            text = f"That did not work ({type(error).__name__}: {error}); the terminal says more."
            notify(self.server, text, level="error", client=client)
            return False
        finally:
            self.refresh()
        return True


class Panel:
    """Part of the control panel: turns clicks into calls of the session, and shows what the session says.

    Callbacks are coroutines: viser runs those in the order of the clicks.
    """

    def __init__(self, page: Page) -> None:
        self.page = page
        self.session = page.session
        self.create(page.server.gui)

    def create(self, gui: viser.GuiApi) -> None:
        """Make the controls, in the container that is open."""
        raise NotImplementedError

    def enter(self, source: Source) -> list[Change]:
        """Return the changes that another source brings."""
        return []

    def close(self) -> None:
        """End what runs on its own."""

    def wait(self) -> list[Change]:
        """Return the changes that tell that there is no frame yet."""
        return []

    def update(self, frame: Frame) -> list[Change]:
        """Return the changes that show `frame` and the session's present settings; called a few times per second."""
        return []
