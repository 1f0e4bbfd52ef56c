"""The number of visitors, and the button that takes control."""

from __future__ import annotations

from collections.abc import Mapping

import viser

from aero_viz.dashboard.layers import Change, apply
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.dashboard.viser_private import inputs
from aero_viz.session.frame import Frame

_VISITORS_CLASS, _TAKE_CONTROL_CLASS = "aero-visitors", "aero-take-control"
"""Classes of the line, and of a line with the button below it."""
_WATCHING_CLASS = "aero-watching"
"""Class of the line of a visitor without control, for whom the style sheet shows shared controls as disabled."""
_HINT = "Take control of the session. The visitor who holds it now can only watch afterwards."


class VisitorPanel(Panel):
    """A line above all controls, separate for each visitor. It is empty for a single visitor who holds control."""

    def create(self, gui: viser.GuiApi) -> None:
        self._clients: dict[int, viser.ClientHandle] = {}
        self._holder: int | None = None
        """Visitor who held control last."""
        self._rows: dict[int, tuple[viser.GuiHtmlHandle, viser.GuiButtonHandle]] = {}
        self._visitors = self.page.server.visitors
        self._visitors.on_change = self._follow

    def welcome(self, client: viser.ClientHandle) -> None:
        number = client.client_id
        text = client.gui.add_html("", order=-2.0, visible=False)
        button = client.gui.add_button(
            "Take control", icon=viser.Icon.STEERING_WHEEL, order=-1.0, hint=_HINT, visible=False
        )
        self._rows[number], self._clients[number] = (text, button), client

        @button.on_click
        async def _(_: viser.GuiEvent) -> None:
            self._visitors.take_control(number)

        self._show()

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        for number in set(self._rows) - set(clients):
            self._rows.pop(number, None)
            self._clients.pop(number, None)

    def update(self, frame: Frame) -> list[Change]:
        self._show()  # the other panels may have given a visitor more controls
        return []

    def _follow(self) -> None:
        """Show who holds control, and tell whoever has lost it."""
        visitors = self._visitors
        before, self._holder = self._holder, next(filter(visitors.has_control, list(self._rows)), None)
        if before != self._holder and before in self._clients and visitors.is_present(before):
            text = 'Another visitor has taken control of the session. Press "Take control" to get it back.'
            self._clients[before].add_notification("You are watching now", text, color="yellow")
        self._show()

    def _show(self) -> None:
        visitors = self._visitors
        for number, (text, button) in list(self._rows.items()):
            controls, may_control = visitors.has_control(number), visitors.may_control(number)
            role = "You control the session." if controls else "You are watching; your camera and layers are your own."
            if not may_control:
                role += " This link cannot control the session."
            count = f"<b>{visitors.count} visitors</b>" if visitors.count != 1 else "<b>1 visitor</b>"
            is_shown = visitors.is_present(number) and (visitors.count > 1 or not controls)
            is_offered = may_control and not controls
            # The style sheet leaves room for elements of these classes.
            classes = _VISITORS_CLASS + (f" {_TAKE_CONTROL_CLASS}" if is_offered else "")
            classes += "" if controls else f" {_WATCHING_CLASS}"
            own = "" if controls or (client := self._clients.get(number)) is None else _own_style(client)
            line = markup.block(f'<span class="{classes}">{count} {markup.muted(role)}</span>{own}')
            changes: list[Change] = [
                (text, "content", line if is_shown else ""),
                (text, "visible", is_shown),
                (button, "visible", is_offered),
            ]
            apply(changes)


def _own_style(client: viser.ClientHandle) -> str:
    """Return a style sheet that shows the visitor's own controls, which need no control of the session, as usual."""
    own = ",".join(f'[id="{uuid}"]' for uuid in list(inputs(client.gui)))
    return f"<style>:is({own}){{opacity:1!important;cursor:auto!important}}</style>" if own else ""
