"""Base of all panels."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import viser

from aero_planner.config import DroneConfig, Value
from aero_viz.dashboard.history import FlightHistory
from aero_viz.dashboard.layers import Change, Layer
from aero_viz.dashboard.server import LocalServer, notify
from aero_viz.errors import UserError
from aero_viz.flight.known_drone import config_for_flight, facts_after
from aero_viz.session.base import BaseSession
from aero_viz.session.frame import Frame
from aero_viz.session.source import SourceInfo

_log = logging.getLogger(__name__)

TYPING_DELAY = 0.2
"""Time after which a value that was typed just before a click has arrived [s]: the page sends it with a delay."""


ARROWS: dict[str, Any] = {
    "scale": 80.0, "line_width": 5.5, "fixed": True, "disable_rotations": True, "depth_test": False, "visible": False,
}  # fmt: skip
"""Arrows that move something in the scene: 80 pixels long and 24 wide for the mouse at any distance."""


class Hold:
    """Keeps a value that a user has just changed from being overwritten with the session's previous one."""

    SECONDS = 1.0
    """Longest time of a hold [s]."""

    def __init__(self) -> None:
        self.began = -self.SECONDS
        """When it began [s], `time.monotonic`."""

    def begin(self) -> None:
        """Hold from now on."""
        self.began = time.monotonic()

    def end(self) -> None:
        """Hold no longer, so that the page shows the session's values."""
        self.began = -self.SECONDS

    def __bool__(self) -> bool:
        return time.monotonic() - self.began < self.SECONDS


@dataclass(frozen=True)
class Page:
    """Objects on which panels act."""

    server: LocalServer
    session: BaseSession
    layers: Mapping[str, Layer]
    """The layers by name."""
    history: FlightHistory
    """Every tick of the source so far."""
    refresh: Callable[[], None]
    """Shows the newest frame again, after a change that brings no new frame."""

    def refresh_after(self, delay: float = 1.1 * Hold.SECONDS) -> None:
        """Show the newest frame again in `delay` [s], since no later frame comes while the session is paused."""
        timer = threading.Timer(delay, self.refresh)
        timer.daemon = True
        timer.start()

    def update_samples(self) -> None:
        """Include the Stage I samples in frames if a visible layer needs them."""
        controls = self.session.controls
        if controls is not None:
            controls.set_samples(any(layer.needs_samples and layer.visible for layer in self.layers.values()))

    def config_for_flight(self, config: DroneConfig) -> DroneConfig:
        """Return `config` with the facts of the flight that is shown."""
        frame = self.session.frame
        return config if frame is None else config_for_flight(config, frame.source)

    def with_facts(self, changes: Mapping[str, Value], *, is_reset: bool = False) -> dict[str, Value]:
        """Return changes of parameters, and the facts of the flight that depend on them.

        A fact that is reset is known again, and one that is entered is used as it is.

        Raises:
            ValueError: a parameter is unknown or out of its bounds.
        """
        frame = self.session.frame
        facts = {} if frame is None else facts_after(changes, config=self.session.config, flight=frame.source)
        return {**changes, **facts} if is_reset else {**facts, **changes}

    def attempt(self, action: Callable[[], Any], client: viser.ClientHandle | None = None) -> bool:
        """Run `action` and return True if it succeeded. A failure is shown to `client`, or to everyone."""
        try:
            action()
        except (UserError, ValueError, OSError) as error:
            notify(self.server, str(error), level="error", client=client)
            return False
        except Exception as error:
            _log.exception("an action of the page failed")
            text = f"{type(error).__name__}: {error}. The terminal shows the details."
            notify(self.server, text, level="error", client=client)
            return False
        finally:
            self.refresh()
        return True

    def ask(
        self, client: viser.ClientHandle, question: str, detail: str, *, yes: str, no: str, action: Callable[[], Any]
    ) -> None:
        """Ask a visitor in a dialog; run `action` if the answer is `yes` and the visitor has control.

        A visitor who may have control but does not hold it takes it with the answer, as the text of the button says.

        Args:
            client: the visitor.
            question: title of the dialog.
            detail: what the question is about, HTML. Not Markdown, which may hold pictures of other servers.
            yes, no: texts of the two buttons.
            action: what to do, as for `attempt`.
        """
        visitors, number = self.server.visitors, client.client_id
        takes_control = visitors.may_control(number) and not visitors.has_control(number)
        shown_yes = f"Take control, {yes[0].lower()}{yes[1:]}" if takes_control else yes
        modal = client.gui.add_modal(question)
        with modal:
            client.gui.add_html(detail)
            answer = client.gui.add_button_group("", (shown_yes, no))

            @answer.on_click
            async def _(_: viser.GuiEvent) -> None:
                modal.close()
                if answer.value != shown_yes:
                    return
                if takes_control:
                    visitors.take_control(number)
                if visitors.has_control(number):  # the modal is the visitor's own
                    self.attempt(action, client)
                elif visitors.may_control(number):  # somebody has taken it meanwhile
                    self.ask(client, question, detail, yes=yes, no=no, action=action)
                else:
                    notify(self.server, "This link cannot control the session.", level="error", client=client)


class Panel:
    """Part of the control panel: turns clicks into calls of the session, and shows the state of the session.

    Callbacks are coroutines, since viser runs coroutines in the order of the clicks.
    """

    title: ClassVar[str] = ""
    """Name of the tab of a panel that has a tab to itself."""
    icon: ClassVar[viser.IconName] = viser.Icon.PUZZLE
    """Icon of that tab."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.session = page.session
        self.create(page.server.gui)

    def create(self, gui: viser.GuiApi) -> None:
        """Create the controls in the open container."""
        raise NotImplementedError

    def welcome(self, client: viser.ClientHandle) -> None:
        """Create the elements of a new visitor, with `client.gui`."""

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        """Drop the elements of visitors who have left."""

    def close(self) -> None:
        """Stop the panel's threads."""

    def on_new_source(self, source: SourceInfo) -> list[Change]:
        """Return the changes that show the constants of another source."""
        return []

    def update_without_frame(self) -> list[Change]:
        """Return the changes that show the session before its first frame."""
        return []

    def update(self, frame: Frame) -> list[Change]:
        """Return the changes that show `frame` and the session's settings. Called a few times per second."""
        return []
