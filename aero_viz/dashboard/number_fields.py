"""Numbers that visitors type: they count on Enter or when their field is left, and not letter by letter."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Hashable, Iterable
from typing import Any

import viser

from aero_viz.dashboard.layers import Change
from aero_viz.dashboard.page_messages import NUMBER_MAX
from aero_viz.errors import UserError

_FIELDS = (viser.GuiNumberHandle, viser.GuiSliderHandle, viser.GuiVector2Handle, viser.GuiVector3Handle)
"""Controls with number fields."""
_TYPING_MAX = 30.0
"""Time after the last key at which nobody types any more [s]; the script of the page ends it by then."""
_FOCUS_MAX = 5.0
"""Time for which a field that somebody has chosen waits for the first key [s]."""

LISTENER = r"""
if (!window.aeroNumbers) {
  window.aeroNumbers = true;
  const FIELD = ".mantine-NumberInput-input", STEPS = ".mantine-NumberInput-controls, .mantine-Slider-root";
  const quiet = new Set();  // controls of which a number was typed last
  let edit = null;
  aeroKeepsBack = message => message.type === "GuiUpdateMessage" && quiet.has(message.uuid);
  const isField = target => target instanceof HTMLInputElement && target.matches(FIELD);
  const row = part => part.closest(".mantine-Flex-root");
  const fields = part => [...row(part).querySelectorAll(FIELD)];
  const control = part => (row(part).querySelector(".mantine-Slider-root") ?? fields(part)[0]).id;
  const tell = (text, isOver) => {
    aeroSend({type: "AeroNumberMessage", uuid: edit.uuid, index: edit.index, text, is_over: isOver});
    clearTimeout(edit.timer);
    if (isOver) clearInterval(edit.watch);
    else edit.timer = setTimeout(end, edit.isTyped ? TYPING_MAX : FOCUS_MAX, true);
  };
  const isSame = (a, b) => a === b || (a.trim() && b.trim() && Number(a) === Number(b));
  const show = (field, text) => {
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, text);
    field.dispatchEvent(new Event("input", {bubbles: true}));
  };
  const end = isKept => {
    const {field, before, refused, isTyped, shown, typed} = edit;
    const text = refused === null ? shown : refused === typed ? typed : `${refused}..`;
    tell(isTyped && isKept && (refused || !isSame(text, before)) ? text : null, true);
    edit = null;
    const isNumber = isKept && text.trim() && Number.isFinite(Number(text));
    const result = !isNumber ? before : refused === null ? shown : `${Number(text)}`;
    if (isTyped && field.value !== result) show(field, result);
  };
  const keep = () => {  // after an update that was on its way
    if (edit.isTyped && edit.field.value !== edit.shown) show(edit.field, edit.shown);
  };
  const begin = target => {
    if (!isField(target) || edit?.field === target) return;
    if (edit) end(true);
    const index = fields(target).indexOf(target);
    edit = {field: target, uuid: control(target), index, refused: null, typed: "", shown: target.value};
    edit.watch = setInterval(keep, 100);
    tell(null, false);
  };
  addEventListener("focusin", ({target}) => begin(target), true);
  addEventListener("beforeinput", ({target, inputType}) => {
    if (inputType === "insertLineBreak") return;  // Enter
    begin(target);
    if (edit?.field !== target) return;
    keep();
    if (edit.isTyped) return;
    quiet.add(edit.uuid);
    edit.before = target.value;
    edit.isTyped = true;
  }, true);
  addEventListener("input", ({target}) => {
    if (edit?.field === target) edit.typed = target.value;
  }, true);
  addEventListener("input", ({target}) => {  // the page has dropped by now what it does not take, such as letters
    if (edit?.field !== target) return;
    const {typed} = edit, shown = target.value, hasPoint = shown.includes(".");
    const isWhole = isSame(typed, shown) && typed.includes(".") === hasPoint;
    const isCut = hasPoint && typed.startsWith(shown) && /^\d+$/.test(typed.slice(shown.length));  // more decimals
    if (typed.length < 2) edit.refused = null;
    if (!isWhole && !isCut) edit.refused ??= typed;
    edit.shown = shown;
    tell(null, false);
  });
  addEventListener("keydown", ({target, key}) => {
    if (edit?.field === target && ["Enter", "Escape", "ArrowUp", "ArrowDown"].includes(key)) end(key !== "Escape");
    const isStep = isField(target) ? ["ArrowUp", "ArrowDown"].includes(key) : target.matches?.("[role=slider]");
    if (isStep) quiet.delete(control(target));
  }, true);
  addEventListener("pointerdown", ({target}) => {
    const steps = target.closest?.(STEPS);
    if (!steps) return;
    if (edit) end(true);
    quiet.delete(control(steps));
  }, true);
  addEventListener("focusout", ({target}) => { if (edit?.field === target) end(true); }, true);
}
""".replace("TYPING_MAX", f"{1e3 * _TYPING_MAX:.0f}").replace("FOCUS_MAX", f"{1e3 * _FOCUS_MAX:.0f}")
"""Script that tells the server what is typed into a number field, and when that is over. It needs `SENDER`.

viser's page reports each key, at most one report per 50 ms, of which another control's may take the place. Of a field
that is typed in, the script keeps these reports to itself, and sends the text when it counts. It counts on Enter, when
the field is left, and after 30 s without a key. Escape, and what is no number, bring back what the field showed before.
Arrows and sliders report at once. While a field waits for keys, for 5 s after it was chosen, it keeps its number.
"""


class NumberFields:
    """The fields that visitors type in. Meanwhile the page does not change what they show."""

    def __init__(self) -> None:
        self.on_waiting: Callable[[], None] = lambda: None
        """Called when fields are left that shall show other values now."""
        self._typed: dict[Hashable, tuple[Any, float]] = {}
        """Control and time of the last key [s], `time.monotonic`, by visitor."""
        self._waiting: dict[int, Change] = {}
        """Newest values that such controls shall show, by the identity of their handle."""
        self._lock = threading.Lock()

    def type(self, visitor: Hashable, control: Any) -> None:
        """Note that a visitor types into a control."""
        with self._lock:
            self._typed[visitor] = control, time.monotonic()

    def leave(self, visitor: Hashable, *, with_number: bool = False) -> None:
        """Note that a visitor has ended typing, or has left; with a number, which replaces values that wait."""
        with self._lock:
            control, _ = self._typed.pop(visitor, (None, 0.0))
            if with_number:
                self._waiting.pop(id(control), None)
            is_waiting = bool(self._waiting)
        if is_waiting:
            self.on_waiting()

    def admit(self, changes: Iterable[Change]) -> list[Change]:
        """Return the changes to make now: without the values of fields that are typed in, with those that waited."""
        with self._lock:
            oldest = time.monotonic() - _TYPING_MAX
            typed = {id(control) for control, typed_at in self._typed.values() if typed_at > oldest}
            if not typed and not self._waiting:
                return list(changes)
            admitted = [change for key, change in self._waiting.items() if key not in typed]
            self._waiting = {key: change for key, change in self._waiting.items() if key in typed}
            for change in changes:
                if change[1] == "value" and id(change[0]) in typed:
                    self._waiting[id(change[0])] = change
                else:
                    admitted.append(change)
            return admitted


def typed_value(control: Any, index: int, text: str) -> Any:
    """Return the value of a control of viser after a text was typed into its number field.

    Args:
        control: number, slider or vector.
        index: component of a vector.
        text: what was typed.

    Raises:
        UserError: it is no number, or not within the bounds of the control; says which value stays.
        ValueError: the control has no such field.
    """
    if not isinstance(control, _FIELDS):
        raise ValueError("there is no such number field")
    value: Any = control.value
    is_vector = isinstance(value, tuple)
    parts = list(value) if is_vector else [value]
    if control.disabled or index >= len(parts):
        raise ValueError("the number field is disabled, or has fewer components")
    old, bounds = parts[index], (control.min, control.max)
    low, high = (bound[index] if isinstance(bound, tuple) else bound for bound in bounds)
    if reason := _refusal(text, low, high, whole=isinstance(old, int)):
        raise UserError(f"{control.label}: {reason}, so {old:g} stays.")
    parts[index] = type(old)(float(text))
    return tuple(parts) if is_vector else parts[0]


def _refusal(text: str, low: float | None, high: float | None, *, whole: bool) -> str:
    """Return why a text does not count as a number, empty if it does."""
    if not text.strip():
        return "the field was empty"
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        return f"{text!r} is not a number in digits, such as -1.5"
    if abs(number) > NUMBER_MAX:
        return f"{text} is too large"
    if whole and number != int(number):
        return f"{text} is not a whole number"
    if low is not None and number < low:
        return f"{text} is less than {low:g}"
    return f"{text} is more than {high:g}" if high is not None and number > high else ""
