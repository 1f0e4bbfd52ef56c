"""The keys of the page, the list of them, and what is typed into its fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import viser

from aero_viz.dashboard import number_fields
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.dashboard.panels.keys import KEYS, LISTENER, Key, rows
from aero_viz.dashboard.viser_private import run_script

Action = Callable[..., object]
"""Called with the visitor, and the argument of the key if it has one."""


class ShortcutPanel(Panel):
    """Registers `KEYS` as commands of viser, which ignores keys while a field is being typed in.

    Args:
        page: page of the panel.
        actions: actions by name; keys of others are left out.
    """

    def __init__(self, page: Page, actions: Mapping[str, Action]) -> None:
        self._actions = {"help": self._toggle_help, "close": self._close_help, **actions}
        self._close_open_help: dict[int, Callable[[], None]] = {}
        """Closes the list of keys, for each client that has it open."""
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._register(gui, own=False)

    def welcome(self, client: viser.ClientHandle) -> None:
        self._register(client.gui, own=True)
        for script in (LISTENER, number_fields.LISTENER):
            run_script(client, script)

    def _register(self, gui: viser.GuiApi, *, own: bool) -> None:
        for key in KEYS:
            if key.own is own and key.action in self._actions:
                self._add(gui, key)

    def _add(self, gui: viser.GuiApi, key: Key) -> None:
        action = self._actions[key.action]

        also = f"or {key.also}" if key.also else None  # the palette shows it before the key itself

        @gui.add_command(key.label, description=also, hotkey=key.hotkey, modifier=key.modifier).on_trigger
        async def _(event: viser.CommandEvent) -> None:
            arguments = () if key.argument is None else (key.argument,)
            self.page.attempt(lambda: action(event.client, *arguments), event.client)

    def _toggle_help(self, client: viser.ClientHandle) -> None:
        if client.client_id in self._close_open_help:
            self._close_help(client)
            return
        modal = client.gui.add_modal("Keys")
        self._close_open_help[client.client_id] = modal.close
        with modal:
            client.gui.add_html(markup.block(markup.table([(shown, label, "") for shown, label in rows()])))
            client.gui.add_button("Close", color="gray").on_click(lambda _: self._close_help(client))

    def _close_help(self, client: viser.ClientHandle) -> None:
        close = self._close_open_help.pop(client.client_id, None)
        if close is not None:
            close()
