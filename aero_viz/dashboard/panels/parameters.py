"""A control for every parameter, built from the planner's table of parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import viser

from aero_planner import PlannerConfig
from aero_planner.config import ParameterInfo, Value, parameters
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels.base import Page, Panel
from aero_viz.session.base import SessionControls
from aero_viz.session.frame import Frame

__all__ = ["LiveParameterPanel", "StructureParameterPanel"]


def _same(value: Any) -> Any:
    return value


@dataclass(frozen=True)
class Control:
    """One parameter on the page."""

    info: ParameterInfo
    handle: Any
    to_page: Callable[[Any], Any] = _same
    to_config: Callable[[Any], Value] = _same

    def show(self, value: Value) -> list[Change]:
        """Return the changes that show `value`."""
        shown = self.to_page(value)
        changes: list[Change] = []
        if isinstance(self.handle, viser.GuiSliderHandle) and shown > self.handle.max:
            changes.append((self.handle, "max", min(self.info.high, _nice(2.0 * shown))))
        return [*changes, (self.handle, "value", shown)]

    @property
    def value(self) -> Value:
        """What the page shows, as the configuration has it."""
        return self.to_config(self.handle.value)


def add_control(gui: viser.GuiApi, info: ParameterInfo, value: Any) -> Control:
    """Add what suits a parameter: dropdown, checkbox, number, slider, or slider over the decimal logarithm."""
    hint = _hint(info)
    if info.choices:
        return Control(info, gui.add_dropdown(info.name, info.choices, initial_value=value, hint=hint))
    if isinstance(info.default, bool):
        return Control(info, gui.add_checkbox(info.name, bool(value), hint=hint))
    if isinstance(info.default, int):
        return Control(
            info, gui.add_number(info.name, int(value), min=int(info.low), max=int(info.high), step=1, hint=hint)
        )
    if info.scale == "log":
        low, high = math.log10(info.low), math.log10(info.high)
        marks = tuple((e, f"{10.0**e:g}") for e in range(math.ceil(low), math.floor(high) + 1))
        handle = gui.add_slider(
            f"log10 {info.name}", low, high, 0.01, math.log10(value), marks=marks[:: max(1, len(marks) - 1)], hint=hint
        )
        return Control(info, handle, lambda v: round(math.log10(v), 2), lambda v: _clamped(info, 10.0**v))
    top = max(_reach(info), float(value))
    step = 10.0 ** math.floor(math.log10((top - info.low) / 90.0))
    return Control(info, gui.add_slider(info.name, info.low, top, step, float(value), hint=hint))


def _hint(info: ParameterInfo) -> str:
    unit = f" {info.unit}" if info.unit else ""
    symbol = f" {info.symbol}." if info.symbol else ""
    bounds = "" if info.choices or isinstance(info.default, bool) else f" {info.low:g} to {info.high:g}{unit}."
    return f"{info.help}{symbol}{bounds} Default {info.default}{unit}."


def _clamped(info: ParameterInfo, value: float) -> float:
    return float(f"{min(max(value, info.low), info.high):.3g}")


def _reach(info: ParameterInfo) -> float:
    """Return where a slider ends: five times the default, as a bound of 1000 leaves no feeling for a 3."""
    return min(info.high, _nice(5.0 * float(info.default))) if info.default else min(info.high, 20.0)


def _nice(value: float) -> float:
    """Return the next 1, 2, 5 or 10 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(value, 1e-9)))
    return next(float(f"{step * power:.6g}") for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9))


class _ParameterPanel(Panel):
    """Controls that show the session's configuration, whoever changes it."""

    def __init__(self, page: Page, controls: SessionControls) -> None:
        self._commands = controls
        self._shown: PlannerConfig | None = None
        self._controls: list[Control] = []
        super().__init__(page)

    def update(self, frame: Frame) -> list[Change]:
        config = self.session.config
        if config is self._shown:
            return []
        self._shown = config
        return [change for control in self._controls for change in _differing(control, config)]


class LiveParameterPanel(_ParameterPanel):
    """Sliders that act at once, in the folders of the configuration."""

    def create(self, gui: viser.GuiApi) -> None:
        live = [info for info in parameters() if info.live]
        for section in dict.fromkeys(info.section for info in live):
            infos = [info for info in live if info.section == section]
            with gui.add_folder(section.capitalize(), expand_by_default=section == "costs"):
                for info in infos:
                    self._add(gui, info)
                reset = gui.add_button(f"Reset {section}", icon=viser.Icon.RESTORE, color="gray")
                self._on_reset(reset, [info.path for info in infos])

    def _add(self, gui: viser.GuiApi, info: ParameterInfo) -> None:
        control = add_control(gui, info, self.session.config.get(info.path))
        self._controls.append(control)

        @control.handle.on_update
        async def _(event: viser.GuiEvent) -> None:
            if event.client is not None and not self.page.attempt(
                lambda: self._commands.configure({info.path: control.value}), event.client
            ):
                self._shown = None

    def _on_reset(self, button: viser.GuiButtonHandle, paths: Sequence[str]) -> None:
        @button.on_click
        async def _(event: viser.GuiEvent) -> None:
            default = PlannerConfig()
            self.page.attempt(lambda: self._commands.configure({p: default.get(p) for p in paths}), event.client)


class StructureParameterPanel(_ParameterPanel):
    """Numbers that size the planner's buffers, applied together with a button."""

    def create(self, gui: viser.GuiApi) -> None:
        with gui.add_form("Structure", expand_by_default=False) as form:
            infos = [info for info in parameters() if not info.live]
            self._controls = [add_control(gui, info, self.session.config.get(info.path)) for info in infos]
            apply = gui.add_button("Apply", hint="Rebuild the planner; takes a moment.", icon=viser.Icon.CHECK)

        @apply.on_click
        async def _(event: viser.GuiEvent) -> None:
            changes = {control.info.path: control.value for control in self._controls}
            if not self.page.attempt(lambda: self._commands.configure(changes), event.client):
                self._shown = None
            form.submit()


def _differing(control: Control, config: PlannerConfig) -> list[Change]:
    """Leave a control alone that stands for the value: writing it rounded would move it under the user's hand."""
    value = config.get(control.info.path)
    return [] if control.value == value else control.show(value)
