"""Controls for single parameters: dropdown, checkboxes, number, or number with a slider."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import viser

from aero_planner.config import ParameterInfo, Value
from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.panels import markup

ChangeCallback = Callable[[viser.ClientHandle], None]
"""Called with the client after a user has changed the value of a control."""

_LARGEST_SLIDER = 5.0
"""Upper end of a slider, as a multiple of the default."""
_WIDEST_SLIDER = 1e4
"""Parameters whose range extends farther below zero have no slider: one pixel would be hundreds of units."""
_DECIMALS = 9
"""Decimal places that can be typed."""


class Control(ABC):
    """One parameter on the page."""

    def __init__(self, info: ParameterInfo) -> None:
        self.info = info
        """The parameter."""

    @property
    @abstractmethod
    def value(self) -> Value:
        """The value on the page."""

    @abstractmethod
    def show(self, value: Value) -> list[Change]:
        """Return the changes that show `value`; none if the page already does."""

    @property
    @abstractmethod
    def handles(self) -> Sequence[Any]:
        """The control's elements on the page."""

    def describe(self, value: Value) -> str:
        """Return a value in few words."""
        return str(value)

    @abstractmethod
    def on_change(self, callback: ChangeCallback) -> None:
        """Call `callback` whenever a user changes the value."""


class _SingleControl(Control):
    """A parameter with one input: dropdown, checkbox or number."""

    def __init__(self, info: ParameterInfo, handle: Any) -> None:
        super().__init__(info)
        self._handle = handle

    @property
    def value(self) -> Value:
        return self._handle.value

    def show(self, value: Value) -> list[Change]:
        return [] if self._handle.value == value else [(self._handle, "value", value)]

    @property
    def handles(self) -> Sequence[Any]:
        return (self._handle,)

    def on_change(self, callback: ChangeCallback) -> None:
        _on_user_change(self._handle, callback)


class ItemsControl(Control):
    """A checkbox for each of the names that a text may list.

    Args:
        gui: where to add it.
        info: the parameter.
        value: first value.
    """

    def __init__(self, gui: viser.GuiApi, info: ParameterInfo, value: str) -> None:
        super().__init__(info)
        self._heading = gui.add_html(markup.block(markup.heading(info.title)))
        listed = value.split(", ")
        self.boxes = {
            name: gui.add_checkbox(name.replace("_", " ").capitalize(), name in listed, hint=_hint(info))
            for name in info.items or ()
        }
        """The checkboxes by the names."""

    @property
    def value(self) -> Value:
        return ", ".join(name for name, box in self.boxes.items() if box.value)

    def show(self, value: Value) -> list[Change]:
        listed = str(value).split(", ")
        return [(box, "value", name in listed) for name, box in self.boxes.items() if box.value != (name in listed)]

    @property
    def handles(self) -> Sequence[Any]:
        return (self._heading, *self.boxes.values())

    def describe(self, value: Value) -> str:
        listed = str(value).split(", ") if value else []
        return {0: "none", len(self.boxes): "all"}.get(len(listed), str(value).replace("_", " "))

    def on_change(self, callback: ChangeCallback) -> None:
        for box in self.boxes.values():
            _on_user_change(box, callback)


class SliderControl(Control):
    """A number field with a slider below it. The field takes any value; the slider covers the usual ones.

    The field has no bounds on the page: the browser would silently replace a value beyond them. The configuration
    refuses such a value and says why.

    Args:
        gui: where to add it.
        info: the parameter.
        value: first value.
        end: upper end of the slider; None takes a usual one.
    """

    def __init__(self, gui: viser.GuiApi, info: ParameterInfo, value: float, *, end: float | None = None) -> None:
        super().__init__(info)
        self._is_log = info.scale == "log"
        low, high = self._to_slider(info.low), self._to_slider(max(_slider_end(info) if end is None else end, value))
        step = 0.01 if self._is_log else 10.0 ** math.floor(math.log10((high - low) / 90.0))
        self.number = gui.add_number(info.title, float(value), step=_number_step(info, step), hint=_hint(info))
        """The number field."""
        self.number.precision = _DECIMALS
        marks = _decades(info) if self._is_log else None
        self.slider = gui.add_slider("", low, high, step, self._to_slider(value), marks=marks)
        """The slider, over the decimal logarithm of the value for a parameter on a logarithmic scale."""

    @property
    def value(self) -> Value:
        return float(self.number.value)

    def show(self, value: Value) -> list[Change]:
        number = float(value)
        changes: list[Change] = []
        if self.number.value != number:
            changes.append((self.number, "value", number))
        if self.slider_value != number:  # left alone if it stands for the value: rounding would move it
            position = self._to_slider(number)
            if position > self.slider.max:
                changes.append(
                    (
                        self.slider,
                        "max",
                        self._to_slider(
                            min(self.info.high, _round_up(2.0 * number) if number > 0.0 else self.info.high)
                        ),
                    )
                )
            changes.append((self.slider, "value", position))
        return changes

    @property
    def handles(self) -> Sequence[Any]:
        return (self.number, self.slider)

    def on_change(self, callback: ChangeCallback) -> None:
        def take_slider(client: viser.ClientHandle) -> None:
            self.number.value = self.slider_value
            callback(client)

        _on_user_change(self.number, callback)
        _on_user_change(self.slider, take_slider)

    def _to_slider(self, value: float) -> float:
        return math.log10(max(value, self.info.low)) if self._is_log else value

    @property
    def slider_value(self) -> float:
        """The value that the slider stands for, within the bounds of the parameter."""
        value = float(f"{10.0**self.slider.value:.3g}" if self._is_log else f"{self.slider.value:.9g}")
        return min(max(value, self.info.low), self.info.high)


def add_control(gui: viser.GuiApi, info: ParameterInfo, value: Any) -> Control:
    """Add the control that suits a parameter."""
    hint = _hint(info)
    if info.choices:
        return _SingleControl(info, gui.add_dropdown(info.title, info.choices, initial_value=value, hint=hint))
    if info.items is not None:
        return ItemsControl(gui, info, value)
    if isinstance(info.default, str):
        return _SingleControl(info, gui.add_text(info.title, value, hint=hint))
    if isinstance(info.default, bool):
        return _SingleControl(info, gui.add_checkbox(info.title, bool(value), hint=hint))
    if isinstance(info.default, int):
        return _SingleControl(info, gui.add_number(info.title, int(value), step=1, hint=hint))
    if info.low < -_WIDEST_SLIDER:
        return add_number(gui, info, value)
    return SliderControl(gui, info, float(value))


def add_number(gui: viser.GuiApi, info: ParameterInfo, value: Any) -> Control:
    """Add a number field without a slider, for a parameter without a usual range."""
    number = gui.add_number(info.title, float(value), step=0.01, hint=_hint(info))
    number.precision = _DECIMALS
    return _SingleControl(info, number)


def _on_user_change(handle: Any, callback: ChangeCallback) -> None:
    @handle.on_update
    async def _(event: viser.GuiEvent) -> None:
        if event.client is not None:  # otherwise the program itself has set the value
            callback(event.client)


def _hint(info: ParameterInfo) -> str:
    unit = f" {info.unit}" if info.unit else ""
    bounds = f" From {info.range}." if info.is_number else ""
    return f"{info.path}: {info.help}{bounds} Default {info.default}{unit}."


def _slider_end(info: ParameterInfo) -> float:
    """Return the upper end of a slider, for a linear one five times the default: one up to 1000 could not set 3 or
    4."""
    if info.scale == "log":
        return info.high
    default = float(info.default)
    return min(info.high, _round_up(_LARGEST_SLIDER * default) if default > 0.0 else info.low + 20.0)


def _number_step(info: ParameterInfo, slider_step: float) -> float:
    """Return the step of the number field's arrows."""
    return 10.0 ** math.floor(math.log10(float(info.default))) if info.scale == "log" else slider_step


def _decades(info: ParameterInfo) -> tuple[tuple[float, str], ...]:
    """Return the marks of a logarithmic slider: position and label of each power of ten."""
    first, last = math.ceil(math.log10(info.low)), math.floor(math.log10(info.high))
    return tuple((float(exponent), f"{10.0**exponent:g}") for exponent in range(first, last + 1))


def _round_up(value: float) -> float:
    """Return the next 1, 2, 5 or 10 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(float(f"{step * power:.6g}") for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value * (1.0 - 1e-9))
