"""Switches and options of the layers."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import viser

from aero_viz.dashboard.layers import Change, Layer, Option
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.planners.plan import lacks
from aero_viz.session.frame import Frame

_ROOM = 100.0
"""Difference in order between two layers; their options are between them."""


class LayerPanel(Panel):
    """A switch for every layer, separate for each visitor, above the layer's options, which all visitors share.

    Args:
        page: page of the panel.
        tab: where to add the controls.
    """

    def __init__(self, page: Page, tab: viser.GuiTabHandle) -> None:
        self._tab = tab
        self._lock = threading.Lock()
        """Only one thread may add controls to a tab at a time."""
        super().__init__(page)

    def create(self, gui: viser.GuiApi) -> None:
        self._switches: dict[int, list[tuple[Layer, viser.GuiCheckboxHandle]]] = {}
        self._dropdowns: list[tuple[Layer, Option, viser.GuiDropdownHandle[Any]]] = []
        self._missing = gui.add_html("", order=-1.0)
        for row, layer in enumerate(self.page.layers.values()):
            for k, option in enumerate(layer.options, start=1):
                self._add_dropdown(gui, layer, option, _ROOM * row + k)

    def welcome(self, client: viser.ClientHandle) -> None:
        with self._lock, self._tab:
            self._switches[client.client_id] = [
                (layer, self._add_switch(client, layer, _ROOM * row))
                for row, layer in enumerate(self.page.layers.values())
            ]

    def forget_all_but(self, clients: Mapping[int, viser.ClientHandle]) -> None:
        for number in set(self._switches) - set(clients):
            self._switches.pop(number, None)

    def _add_switch(self, client: viser.ClientHandle, layer: Layer, order: float) -> viser.GuiCheckboxHandle:
        number = client.client_id
        visible, hint = layer.is_visible_to(number), type(layer).__doc__
        switch = client.gui.add_checkbox(layer.title, visible, hint=hint, order=order, visible=layer.available)

        @switch.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                self._show(layer, number, switch.value)

        return switch

    def _show(self, layer: Layer, number: int, visible: bool) -> None:
        layer.show_to(number, visible)
        if layer.needs_samples:
            self.page.update_samples()
        self.page.refresh()

    def toggle(self, client: viser.ClientHandle, name: str) -> None:
        """Show a layer to a visitor, or hide it."""
        if (layer := self.page.layers.get(name)) is not None and layer.available:
            self._show(layer, client.client_id, not layer.is_visible_to(client.client_id))

    def _add_dropdown(self, gui: viser.GuiApi, layer: Layer, option: Option, order: float) -> None:
        choices = tuple(option.choices(self.session.config))
        dropdown = gui.add_dropdown(option.label, choices, initial_value=option.value, hint=option.hint, order=order)
        self._dropdowns.append((layer, option, dropdown))

        @dropdown.on_update
        async def _(_: viser.GuiEvent) -> None:
            option.value = dropdown.value
            self.page.refresh()

    def update(self, frame: Frame) -> list[Change]:
        missing = lacks(frame.plan, *dict.fromkeys(layer.needs for layer in self.page.layers.values() if layer.needs))
        changes: list[Change] = [(self._missing, "content", markup.note(missing) if missing else "")]
        for number, switches in list(self._switches.items()):
            for layer, switch in switches:
                changes += [(switch, "visible", layer.available), (switch, "value", layer.is_visible_to(number))]
        for layer, option, dropdown in self._dropdowns:
            choices = tuple(option.choices(self.session.config))
            if dropdown.options != choices:
                changes.append((dropdown, "options", choices))
            changes.append((dropdown, "visible", layer.available and layer.visible))
        return changes
