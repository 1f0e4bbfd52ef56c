"""Panels with a control for every parameter, built from the planner's table of parameters."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import viser

from aero_planner.config import DroneConfig, Value
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.own_view import OwnView
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.configuration import Baseline
from aero_viz.dashboard.panels.parameter_row import ParameterRow
from aero_viz.dashboard.viser_private import identifier
from aero_viz.flight.known_drone import config_without_facts
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame

_RESET_HINT = "Return these parameters to the preset."
_SEARCH_HINT = "Words of a name, a symbol, a group or an explanation."
_SHOW = ("basic", "expert", "changed")
_SHOW_HINT = (
    "basic: the few parameters that are tuned first, and what differs from the preset; expert: all; changed: only what "
    "differs. A search looks through all of them."
)


@dataclass(frozen=True)
class _Group:
    folder: viser.GuiFolderHandle
    rows: Sequence[ParameterRow]


@dataclass
class _Search:
    """What one visitor searches for."""

    text: viser.GuiTextHandle
    level: viser.GuiDropdownHandle[Any]
    view: OwnView
    shown: tuple[int, str, str] | None = None
    """What the view shows: version of the values, text and level."""


class ParameterPanel(Panel):
    """Controls that show the configuration of the session, whoever changes it, in a folder per group of parameters.

    Live parameters act at once. Those that size the planner's buffers are applied together with a button. Each visitor
    has a search of its own.

    Args:
        page: page of the panel.
        session_controls: commands of the session.
        baseline: preset that the page compares the configuration with.
        tab: where the controls are added.
    """

    def __init__(
        self, page: Page, session_controls: SessionControls, baseline: Baseline, tab: viser.GuiTabHandle
    ) -> None:
        self._session_controls = session_controls
        self._baseline = baseline
        self._tab = tab
        self._lock = threading.Lock()
        """Only one thread may add controls to a tab at a time."""
        self._searches: dict[int, _Search] = {}
        self._shown: tuple[object, ...] | None = None
        self._refused: tuple[object, ...] | None = None
        """Configuration, preset and source at the last refusal, which is shown until one of them changes."""
        self._groups: list[_Group] = []
        self._different: set[str] = set()
        """Paths of the parameters that differ from the preset."""
        self._version = 0
        """Number of times that the values were shown."""
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._none = gui.add_html(markup.note("No parameter matches."), visible=False)
        live = [info for info in self.session.config.parameters() if info.live]
        for group in dict.fromkeys(info.group for info in live):
            with gui.add_folder(group, visible=any(info.basic for info in live if info.group == group)) as folder:
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
        # No form: Enter would submit it.
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
            self._configure(rows, {row.info.path: row.control.value for row in rows}, event.client)

    def welcome(self, client: viser.ClientHandle) -> None:
        order, gui = self._none.order, client.gui
        with self._lock, self._tab:
            text = gui.add_text("Search", "", hint=_SEARCH_HINT, order=order - 0.2)
            level = gui.add_dropdown("Show", _SHOW, initial_value="basic", hint=_SHOW_HINT, order=order - 0.1)
            self._searches[client.client_id] = _Search(text, level, OwnView(client))
        for handle in (text, level):
            handle.on_update(self._refresh)

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        for number in set(self._searches) - set(clients):
            self._searches.pop(number, None)

    def find(self, client: viser.ClientHandle, path: str) -> str | None:
        """Let a visitor search for a parameter; return the identifier of its field, None if there is none."""
        rows = [row for group in self._groups for row in group.rows if row.info.path == path]
        search = self._searches.get(client.client_id)
        if not rows or search is None:
            return None
        search.text.value = path
        self.page.refresh()
        return identifier(rows[0].control.handles[0])

    async def _refresh(self, _: viser.GuiEvent) -> None:
        self.page.refresh()

    def update(self, frame: Frame) -> list[Change]:
        changes: list[Change] = []
        shown = (self.session.config, self._baseline.config, frame.source)
        if shown != self._shown:
            self._shown, self._version = shown, self._version + 1
            if self._refused is not None and self._refused != shown:
                self._refused = None
                for row in (row for group in self._groups for row in group.rows):
                    row.refuse("")
            changes = self._show_values(frame)
        for search in list(self._searches.values()):
            wanted = (self._version, search.text.value.strip(), search.level.value)
            if wanted != search.shown:
                search.shown = wanted
                changes += search.view.show(self._matching(*wanted[1:]))
        return changes

    def _show_values(self, frame: Frame) -> list[Change]:
        """Return the changes that show all values, and which differ from the preset."""
        config, preset = self.session.config, self._baseline.config
        plain = config_without_facts(config, frame.source)
        changes: list[Change] = []
        self._different.clear()
        for row in (row for group in self._groups for row in group.rows):
            path = row.info.path
            if plain.get(path) != preset.get(path):
                self._different.add(path)
            value = config.get(path)
            changes += row.show(value, preset.get(path) if path in self._different else value)
        return changes

    def _matching(self, query: str, level: str) -> list[tuple[Any, bool]]:
        """Return which elements a visitor sees with a search and a level."""
        visible: list[tuple[Any, bool]] = []
        is_any = False
        for group in self._groups:
            are_visible = [row.matches(query) if query else self._is_shown(row, level) for row in group.rows]
            for row, is_visible in zip(group.rows, are_visible, strict=True):
                visible += row.visibility(is_visible)
            visible.append((group.folder, any(are_visible)))
            is_any = is_any or any(are_visible)
        return [*visible, (self._none, not is_any)]

    def _is_shown(self, row: ParameterRow, level: str) -> bool:
        return row.info.path in self._different or level == "expert" or (level == "basic" and row.info.basic)

    def _take(self, row: ParameterRow, client: viser.ClientHandle) -> None:
        self._configure([row], {row.info.path: row.control.value}, client)

    def _reset(self, row: ParameterRow, client: viser.ClientHandle | None) -> None:
        self._return_to_preset([row], client)

    def _on_reset(self, button: viser.GuiButtonHandle, rows: Sequence[ParameterRow]) -> None:
        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            self._return_to_preset(rows, event.client)

    def _return_to_preset(self, rows: Sequence[ParameterRow], client: viser.ClientHandle | None) -> None:
        changes: dict[str, Value] = {row.info.path: self._baseline.config.get(row.info.path) for row in rows}
        self._configure(rows, changes, client, is_reset=True)

    def _configure(
        self,
        rows: Sequence[ParameterRow],
        changes: dict[str, Value],
        client: viser.ClientHandle | None,
        *,
        is_reset: bool = False,
    ) -> None:
        """Change some parameters; if the change is refused, show the values that stay, and the reason."""
        reason = ""

        def configure() -> None:
            nonlocal reason
            try:
                self._session_controls.configure(self.page.with_facts(changes, is_reset=is_reset))
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
        return self.update_without_frame()

    def update_without_frame(self) -> list[Change]:
        config = self.session.config
        if config is self._shown:
            return []
        self._shown = config
        rows = [(info.title, f"{config.get(info.path)}", info.path) for info in config.parameters()]
        return [(self._table, "content", markup.block(markup.table(rows)))]
