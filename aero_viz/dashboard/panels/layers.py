"""Which layers are shown, and how they are coloured."""

from __future__ import annotations

import viser

from aero_viz.dashboard.layers import Change, Layer
from aero_viz.dashboard.layers.cloud import CloudLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.layers.samples import BEST, SampleLayer
from aero_viz.dashboard.panels.base import Panel
from aero_viz.session.frame import Frame

__all__ = ["LayerPanel"]

_CHOSEN = "the chosen one"


class LayerPanel(Panel):
    """A switch for every layer."""

    def create(self, gui: viser.GuiApi) -> None:
        self._switches: dict[str, viser.GuiCheckboxHandle] = {}
        for layer in self.page.layers.values():
            self._add_switch(gui, layer)
            if isinstance(layer, RolloutLayer | CloudLayer):
                self._add_colors(gui, layer)
            elif isinstance(layer, SampleLayer):
                self._add_instances(gui, layer)

    def _add_switch(self, gui: viser.GuiApi, layer: Layer) -> None:
        switch = self._switches[layer.name] = gui.add_checkbox(layer.title, layer.visible, hint=type(layer).__doc__)

        @switch.on_update
        async def _(event: viser.GuiEvent) -> None:
            layer.visible = switch.value
            if isinstance(layer, SampleLayer) and event.client is not None:
                self.session.set_samples(switch.value)
            self.page.refresh()

    def _add_colors(self, gui: viser.GuiApi, layer: RolloutLayer | CloudLayer) -> None:
        colors = gui.add_dropdown("coloured by", layer.colors, initial_value=layer.color_by)

        @colors.on_update
        async def _(_: viser.GuiEvent) -> None:
            layer.color_by = colors.value
            self.page.refresh()

    def _add_instances(self, gui: viser.GuiApi, layer: SampleLayer) -> None:
        hint = "Whose samples are drawn."
        self._instances = gui.add_dropdown("of instance", self._instance_names(), initial_value=_CHOSEN, hint=hint)

        @self._instances.on_update
        async def _(_: viser.GuiEvent) -> None:
            layer.instance = BEST if self._instances.value == _CHOSEN else int(self._instances.value.split()[0])
            self.page.refresh()

    def _instance_names(self) -> tuple[str, ...]:
        return (_CHOSEN, *(f"{i} {kind}" for i, kind in enumerate(self.session.config.kinds)))

    def update(self, frame: Frame) -> list[Change]:
        changes: list[Change] = []
        for name, switch in self._switches.items():
            layer = self.page.layers[name]
            changes += [(switch, "visible", layer.available), (switch, "value", layer.visible)]
        if self._instances.options != self._instance_names():
            changes.append((self._instances, "options", self._instance_names()))
        return [*changes, (self._instances, "visible", self.page.layers["samples"].visible)]
