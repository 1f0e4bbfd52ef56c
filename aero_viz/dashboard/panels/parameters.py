"""Panels with a control for every parameter, built from the planner's table of parameters."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass

import viser

from aero_planner.config import DroneConfig
from aero_viz.dashboard.layers import Change, apply
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import TYPING_DELAY, Page, Panel
from aero_viz.dashboard.panels.configuration import Baseline
from aero_viz.dashboard.panels.parameter_row import ParameterRow
from aero_viz.flight.known_drone import config_without_facts, facts_after
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame

_RESET_HINT = "Return these parameters to the preset."
_SHOW = ("basic", "expert", "changed")
_SHOW_HINT = (
    "basic: the few parameters that are tuned first, and what differs from the preset; expert: all; changed: only what "
    "differs. A search looks through all of them."
)


@dataclass(frozen=True)
class _Group:
    folder: viser.GuiFolderHandle
    rows: Sequence[ParameterRow]


class ParameterPanel(Panel):
    """Controls that show the configuration of the session, whoever changes it, in a folder per group of parameters.

    Live parameters act at once. Those that size the planner's buffers are applied together with a button.

    Args:
        page: page of the panel.
        session_controls: commands of the session.
        baseline: preset that the page compares the configuration with.
    """

    def __init__(self, page: Page, session_controls: SessionControls, baseline: Baseline) -> None:
        self._session_controls = session_controls
        self._baseline = baseline
        self._shown: tuple[object, ...] | None = None
        self._refused: tuple[object, ...] | None = None
        """Configuration, preset and source at the last refusal, which is shown until one of them changes."""
        self._groups: list[_Group] = []
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._search = gui.add_text("Search", "", hint="Words of a name, a symbol, a group or an explanation.")
        self._level = gui.add_dropdown("Show", _SHOW, initial_value="basic", hint=_SHOW_HINT)
        self._none = gui.add_html(markup.note("No parameter matches."), visible=False)
        for handle in (self._search, self._level):
            handle.on_update(self._refresh)
        live = [info for info in self.session.config.parameters() if info.live]
        for group in dict.fromkeys(info.group for info in live):
            with gui.add_folder(group) as folder:
                rows = [
                    ParameterRow(
                        gui, info, self.session.config.get(info.path), on_change=self._take, on_reset=self._reset
                    )
                    for info in live
                    if info.group == group
                ]
                reset = gui.add_button(
                    f"Reset {group.lower()}", icon=viser.Icon.RESTORE, color="gray", hint=_RESET_HINT
                )
            self._groups.append(_Group(folder, rows))
            self._on_reset(reset, rows)
        self._create_structure(gui)

    def _create_structure(self, gui: viser.GuiApi) -> None:
        # No form: Enter would submit it, and viser drops a number that was typed in the 50 ms before.
        with gui.add_folder("Structure") as folder:
            rows = [
                ParameterRow(gui, info, self.session.config.get(info.path), on_change=None, on_reset=self._reset)
                for info in self.session.config.parameters()
                if not info.live
            ]
            hint = "Rebuild the planner with these values. Kernels that are new to this machine take a minute."
            apply = gui.add_button("Apply", hint=hint, icon=viser.Icon.CHECK)
        self._groups.append(_Group(folder, rows))

        @apply.on_click
        async def _(event: viser.GuiEvent) -> None:
            await asyncio.sleep(TYPING_DELAY)
            self._configure(rows, {row.info.path: row.control.value for row in rows}, event.client)

    async def _refresh(self, _: viser.GuiEvent) -> None:
        self.page.refresh()

    def update(self, frame: Frame) -> list[Change]:
        config, query, level = self.session.config, self._search.value.strip(), self._level.value
        shown = (config, self._baseline.config, frame.source, query, level)
        if shown == self._shown:
            return []
        self._shown, preset = shown, self._baseline.config
        if self._refused is not None and self._refused != shown[:3]:
            self._refused = None
            for row in (row for group in self._groups for row in group.rows):
                row.refuse("")
        plain = config_without_facts(config, frame.source)
        changes: list[Change] = []
        is_any = False
        for group in self._groups:
            are_visible = []
            for row in group.rows:
                value, default = config.get(row.info.path), preset.get(row.info.path)
                differs = plain.get(row.info.path) != default
                is_visible = row.matches(query) if query else self._is_shown(row, level, differs=differs)
                changes += row.show(value, default if differs else value, visible=is_visible)
                are_visible.append(is_visible)
            changes.append((group.folder, "visible", any(are_visible)))
            is_any = is_any or any(are_visible)
        return [*changes, (self._none, "visible", not is_any)]

    def _is_shown(self, row: ParameterRow, level: str, *, differs: bool) -> bool:
        return differs or level == "expert" or (level == "basic" and row.info.basic)

    def _take(self, row: ParameterRow, client: viser.ClientHandle) -> None:
        self._configure([row], {row.info.path: row.control.value}, client)

    def _reset(self, row: ParameterRow, client: viser.ClientHandle | None) -> None:
        self._refill([row])
        self._return_to_preset([row], client)

    def _on_reset(self, button: viser.GuiButtonHandle, rows: Sequence[ParameterRow]) -> None:
        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._refill(rows)
            self._return_to_preset(rows, event.client)

    def _refill(self, rows: Sequence[ParameterRow]) -> None:
        """Let fields that were cleared on a page show their numbers again.

        The page does not report a cleared field, and ignores a number that it believes to show.
        """
        for row in rows:
            apply(row.control.disturb())
        self.page.server.flush()
        self._shown = None
        self.page.refresh_after(TYPING_DELAY)

    def _return_to_preset(self, rows: Sequence[ParameterRow], client: viser.ClientHandle | None) -> None:
        changes: dict[str, object] = {row.info.path: self._baseline.config.get(row.info.path) for row in rows}
        self._configure(rows, changes, client, is_reset=True)

    def _configure(
        self,
        rows: Sequence[ParameterRow],
        changes: dict[str, object],
        client: viser.ClientHandle | None,
        *,
        is_reset: bool = False,
    ) -> None:
        """Change some parameters; if the change is refused, show the values that stay, and the reason.

        Facts of the flight that depend on these parameters change with them. A fact that is reset is known again, and
        one that is entered is used as it is.
        """
        reason, frame = "", self.session.frame

        def configure() -> None:
            nonlocal reason
            try:
                facts = {} if frame is None else facts_after(changes, config=self.session.config, flight=frame.source)
                self._session_controls.configure({**changes, **facts} if is_reset else {**facts, **changes})
            except ValueError as error:
                reason = str(error)
                raise

        self.page.attempt(configure, client)
        named = [row for row in rows if row.info.path in reason] or list(rows[:1])
        for row in rows:
            row.refuse(f"Refused: {reason}" if reason and row in named else "")
        frame = self.session.frame
        if reason and frame is not None:
            self._refused = (self.session.config, self._baseline.config, frame.source)
        self._shown = None
        self.page.refresh()


class ParameterTablePanel(Panel):
    """Table of all parameters of a session that takes no commands."""

    def create(self, gui: viser.GuiApi) -> None:
        self._shown: DroneConfig | None = None
        self._table = gui.add_html("")

    def update(self, frame: Frame) -> list[Change]:
        config = self.session.config
        if config is self._shown:
            return []
        self._shown = config
        rows = [(info.title, f"{config.get(info.path)}", info.path) for info in config.parameters()]
        return [(self._table, "content", markup.block(markup.table(rows)))]
