"""Switches and options of the layers."""

from __future__ import annotations

from typing import Any

import viser

from aero_viz.dashboard.layers import Change, Layer, Option
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame

__all__ = ["LayerPanel"]


class LayerPanel(Panel):
    """A switch for every layer, with the layer's options below it."""

    def create(self, gui: viser.GuiApi) -> None:
        self._switches: list[tuple[Layer, viser.GuiCheckboxHandle]] = []
        self._dropdowns: list[tuple[Layer, Option, viser.GuiDropdownHandle[Any]]] = []
        for layer in self.page.layers.values():
            self._add_switch(gui, layer)
            for option in layer.options:
                self._add_dropdown(gui, layer, option)

    def _add_switch(self, gui: viser.GuiApi, layer: Layer) -> None:
        switch = gui.add_checkbox(layer.title, layer.visible, hint=type(layer).__doc__)
        self._switches.append((layer, switch))

        @switch.on_update
        async def _(event: viser.GuiEvent) -> None:
            layer.visible = switch.value
            if layer.needs_samples and event.client is not None:
                self.page.update_samples()
            self.page.refresh()

    def _add_dropdown(self, gui: viser.GuiApi, layer: Layer, option: Option) -> None:
        choices = tuple(option.choices(self.session.config))
        dropdown = gui.add_dropdown(option.label, choices, initial_value=option.value, hint=option.hint)
        self._dropdowns.append((layer, option, dropdown))

        @dropdown.on_update
        async def _(_: viser.GuiEvent) -> None:
            option.value = dropdown.value
            self.page.refresh()

    def update(self, frame: Frame) -> list[Change]:
        changes: list[Change] = []
        for layer, switch in self._switches:
            changes += [(switch, "visible", layer.available), (switch, "value", layer.visible)]
        for layer, option, dropdown in self._dropdowns:
            choices = tuple(option.choices(self.session.config))
            if dropdown.options != choices:
                changes.append((dropdown, "options", choices))
            changes.append((dropdown, "visible", layer.available and layer.visible))
        return changes
