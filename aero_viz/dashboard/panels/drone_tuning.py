"""Parameters of a drone in flight, and the changes of them that are being prepared, sent and answered."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace

import viser

from aero_planner.config import Value
from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Panel
from aero_viz.dashboard.panels.parameter_row import ParameterRow
from aero_viz.session.drone_tuning import DroneParameters, DroneTuning
from aero_viz.session.frame import Frame

_CONFIRM_TIME = 5.0
"""Time within which a second click sends a change to an armed drone [s]."""
_SEND_HINT = "Send the changes above. The drone checks them and takes them between two plans."
_STEPS = ("undo", "back to take-off")
_STEPS_HINT = "undo: the parameters before the last change; back to take-off: those with which the drone took off."


class DroneTuningPanel(Panel):
    """A control for each parameter that the node lets viewers change. Nothing is sent before "Send" is pressed.

    An armed drone takes a second click. What was sent is shown as pending until the drone has answered.
    """

    def create(self, gui: viser.GuiApi) -> None:
        self._draft: dict[str, Value] = {}
        """Values that were entered and not sent. Those that the drone has meanwhile do not count."""
        self._clicked: tuple[Mapping[str, Value], float] = {}, -_CONFIRM_TIME
        """What the first click was about, and when it was [s]."""
        infos = [replace(info, basic=True) for info in self._tuning.tunable.values()]
        self.rows = [
            ParameterRow(
                gui, info, self.session.config.get(info.path), on_change=self._enter, on_reset=self._reset,
                origin="the drone's value",
            )
            for info in infos
        ]  # fmt: skip
        """A control for each parameter."""
        self.send = gui.add_button("Send", icon=viser.Icon.SEND, hint=_SEND_HINT, visible=False)
        """Sends what was entered."""
        self.steps = gui.add_button_group("History", _STEPS, hint=_STEPS_HINT, visible=False)
        """Undo, and back to take-off."""
        self.report = gui.add_html("")
        """What the drone has said."""

        @self.send.on_click
        async def _(event: viser.GuiEvent) -> None:
            self.page.attempt(self._send_draft, event.client)

        @self.steps.on_click
        async def _(event: viser.GuiEvent) -> None:
            step = self._tuning.undo if self.steps.value == "undo" else self._tuning.back_to_takeoff
            self.page.attempt(lambda: self._send(step), event.client)

    @property
    def _tuning(self) -> DroneTuning:
        """That of the present connection."""
        tuning = self.session.tuning
        assert tuning is not None  # the layout has asked
        return tuning

    def _enter(self, row: ParameterRow, _: viser.ClientHandle) -> None:
        path, value = row.info.path, row.control.value
        reason = ""
        try:
            value = row.info.check(value)
        except ValueError as error:
            reason = f"Refused: {error}"
        row.refuse(reason)
        if reason or value == self._value(path):
            self._draft.pop(path, None)
        else:
            self._draft[path] = value
        self.page.refresh()

    def _reset(self, row: ParameterRow, _: viser.ClientHandle | None) -> None:
        row.refuse("")
        self._draft.pop(row.info.path, None)
        self.page.refresh()

    def _value(self, path: str) -> Value:
        """Return the drone's value."""
        return self._tuning.state.values.get(path, self.session.config.get(path))

    def _changes(self) -> dict[str, Value]:
        """Return what was entered and differs from the drone."""
        return {path: value for path, value in dict(self._draft).items() if value != self._value(path)}

    def _send_draft(self) -> None:
        """Send what was entered; to an armed drone, with the second click."""
        draft, now = self._changes(), time.monotonic()
        first, clicked_at = self._clicked
        is_second = draft == first and now - clicked_at < _CONFIRM_TIME
        if self._tuning.state.armed and not is_second:
            self._clicked = draft, now
            self.page.refresh_after(_CONFIRM_TIME)
            return
        self._send(lambda: self._tuning.change(draft, confirmed=is_second))

    def _send(self, ask: Callable[[], None]) -> None:
        self._clicked = {}, -_CONFIRM_TIME
        ask()
        self._draft.clear()

    def update(self, frame: Frame) -> list[Change]:
        return self.update_without_frame()

    def update_without_frame(self) -> list[Change]:
        state, draft = self._tuning.state, self._changes()
        changes: list[Change] = []
        for row in self.rows:
            value = self._value(row.info.path)
            changes += row.show(draft.get(row.info.path, value), value)
            changes += [(handle, "visible", visible) for handle, visible in row.visibility(True)]
            changes += [(handle, "disabled", bool(state.obstacle)) for handle in row.control.handles]
        is_free = not state.obstacle and not state.pending
        first, clicked_at = self._clicked
        is_asked = bool(draft) and draft == first and time.monotonic() - clicked_at < _CONFIRM_TIME
        return [
            *changes,
            (self.send, "visible", is_free and bool(draft)),
            (self.send, "label", "The drone is armed: click again to send" if is_asked else "Send to the drone"),
            (self.steps, "visible", is_free and (state.can_undo or not state.at_takeoff)),
            (self.report, "content", _report(state)),
        ]


def _report(state: DroneParameters) -> str:
    """Return the state of the parameters as HTML."""
    if state.obstacle:
        return markup.note(state.obstacle)
    parts = [markup.heading("Version on the drone", f"{state.version}")]
    if state.pending:
        parts.append(markup.pill("pending", palette.WARNING) + markup.text(state.pending))
    if state.refused:
        parts.append(markup.pill("refused", palette.BAD) + markup.text(state.refused))
    return markup.block(*parts)
