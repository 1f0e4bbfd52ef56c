"""Panels with a control for every parameter, built from the planner's table of parameters."""

from __future__ import annotations

import asyncio

import viser

from aero_planner import PlannerConfig
from aero_planner.config import ParameterInfo
from aero_viz.dashboard.layers import Change, apply
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import TYPING_DELAY, Page, Panel
from aero_viz.dashboard.panels.controls import Control, add_control
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame

__all__ = ["LiveParameterPanel", "ParameterTablePanel", "StructureParameterPanel"]

_RESET_HINT = "Return these parameters to their defaults."


class _ParameterPanel(Panel):
    """Controls that show the configuration of the session, whoever changes it."""

    def __init__(self, page: Page, session_controls: SessionControls) -> None:
        self._session_controls = session_controls
        self._shown: PlannerConfig | None = None
        self._controls: list[Control] = []
        super().__init__(page)

    def update(self, frame: Frame) -> list[Change]:
        config = self.session.config
        if config is self._shown:
            return []
        self._shown = config
        return [change for control in self._controls for change in control.show(config.get(control.info.path))]

    def _refill(self, controls: list[Control]) -> None:
        """Let fields that were cleared on a page show their numbers again.

        The page does not report a cleared field, and ignores a number that it believes to show.
        """
        for control in controls:
            apply(control.disturb())
        self.page.server.flush()
        self._shown = None
        self.page.refresh_after(TYPING_DELAY)

    def _configure(self, changes: dict[str, object], client: viser.ClientHandle | None) -> None:
        """Change some parameters; if the change is refused, show the values that stay."""
        if not self.page.attempt(lambda: self._session_controls.configure(changes), client):
            self._shown = None


class LiveParameterPanel(_ParameterPanel):
    """Controls that act at once, in a folder per group of parameters."""

    def create(self, gui: viser.GuiApi) -> None:
        live = [info for info in PlannerConfig.parameters() if info.live]
        for group in dict.fromkeys(info.group for info in live):
            infos = [info for info in live if info.group == group]
            with gui.add_folder(group, expand_by_default=infos[0].section == "costs"):
                for info in infos:
                    self._add(gui, info)
                reset = gui.add_button(
                    f"Reset {group.lower()}", icon=viser.Icon.RESTORE, color="gray", hint=_RESET_HINT
                )
                self._on_reset(reset, [info.path for info in infos])

    def _add(self, gui: viser.GuiApi, info: ParameterInfo) -> None:
        control = add_control(gui, info, self.session.config.get(info.path))
        control.on_change(lambda client: self._configure({info.path: control.value}, client))
        self._controls.append(control)

    def _on_reset(self, button: viser.GuiButtonHandle, paths: list[str]) -> None:
        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            default = PlannerConfig()
            self._refill([control for control in self._controls if control.info.path in paths])
            self._configure({path: default.get(path) for path in paths}, event.client)


class StructureParameterPanel(_ParameterPanel):
    """Numbers that size the planner's buffers, applied together with a button."""

    def create(self, gui: viser.GuiApi) -> None:
        # No form: Enter would submit it, and viser drops a number that was typed in the 50 ms before.
        with gui.add_folder("Structure", expand_by_default=False):
            infos = [info for info in PlannerConfig.parameters() if not info.live]
            self._controls = [add_control(gui, info, self.session.config.get(info.path)) for info in infos]
            hint = "Rebuild the planner with these values; this takes a moment."
            apply = gui.add_button("Apply", hint=hint, icon=viser.Icon.CHECK)

        @apply.on_click
        async def _(event: viser.GuiEvent) -> None:
            await asyncio.sleep(TYPING_DELAY)
            self._configure({control.info.path: control.value for control in self._controls}, event.client)


class ParameterTablePanel(Panel):
    """Table of all parameters of a session that takes no commands."""

    def create(self, gui: viser.GuiApi) -> None:
        self._shown: PlannerConfig | None = None
        self._table = gui.add_html("")

    def update(self, frame: Frame) -> list[Change]:
        config = self.session.config
        if config is self._shown:
            return []
        self._shown = config
        rows = [(info.title, f"{config.get(info.path)}", info.path) for info in PlannerConfig.parameters()]
        return [(self._table, "content", markup.block(markup.table(rows)))]
