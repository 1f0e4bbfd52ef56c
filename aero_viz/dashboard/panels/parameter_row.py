"""One parameter on the page: its control, whether it differs from the preset, and why a value was refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from aero_planner.config import ParameterInfo, Value
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.controls import Control, add_control

CHANGED_CLASS = "aero-changed"
"""Class of the element before a control whose value differs from the preset."""


class ParameterRow:
    """A control with a mark before it and a button below it, which are visible while the value differs.

    All visitors share it; whether one sees it is up to `visibility`. At first, everyone sees the basic parameters.

    Args:
        gui: where to add them.
        info: the parameter.
        value: value to show at first.
        on_change: called with the row and the client after a user has changed the value.
        on_reset: called with the row and the client when the value of the preset is asked for.
        origin: whose value that is.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        info: ParameterInfo,
        value: Value,
        *,
        on_change: Callable[[ParameterRow, viser.ClientHandle], None] | None,
        on_reset: Callable[[ParameterRow, viser.ClientHandle | None], None],
        origin: str = "the preset",
    ) -> None:
        self.info = info
        self._mark = gui.add_html("", visible=False)
        self.control: Control = add_control(gui, info, value)
        self._reset = gui.add_button_group("", ("reset",), hint=f"Return {info.path} to {origin}.", visible=False)
        self._words = _plain(f"{info.path} {info.title} {info.group} {info.help}")
        self._refusal = ""
        self._is_marked = self._differs = False
        for handle in self.control.handles:
            handle.visible = info.basic
        if on_change is not None:
            self.control.on_change(lambda client: on_change(self, client))

        @self._reset.on_click
        async def _(event: viser.GuiEvent) -> None:
            on_reset(self, event.client)

    def matches(self, query: str) -> bool:
        """Return True if the parameter's path, flag, label, symbol, group or help contains every word of `query`."""
        return all(_plain(word).strip() in self._words for word in query.split())

    def refuse(self, reason: str) -> None:
        """Show why a value was refused, until the next call; empty shows nothing."""
        self._refusal = reason

    def show(self, value: Value, preset: Value) -> list[Change]:
        """Return the changes that show the value and how it differs from the preset."""
        self._differs = value != preset
        refusal = f'<div style="color:{markup.ink(palette.BAD)};font-size:11px;padding:2px 12px">{{}}</div>'
        content = refusal.format(markup.text(self._refusal)) if self._refusal else ""
        if self._differs:
            content += f'<i class="{CHANGED_CLASS}"></i>'
        self._is_marked = bool(content)
        return [
            (self._mark, "content", content),
            (self._reset, "label", f"was {self.control.describe(preset)}"),
            *self.control.show(value),
        ]

    def visibility(self, is_visible: bool) -> list[tuple[Any, bool]]:
        """Return which of the elements a visitor sees who sees the row, or does not."""
        return [
            (self._mark, is_visible and self._is_marked),
            (self._reset, is_visible and self._differs),
            *((handle, is_visible) for handle in self.control.handles),
        ]


def _plain(text: str) -> str:
    """Return a text in which a path is written as its flag is: --costs.q-track sets costs.q_track."""
    return text.lower().replace("_", " ").replace("-", " ")
