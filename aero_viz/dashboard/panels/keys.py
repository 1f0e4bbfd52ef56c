"""The keys of the page: one table for the commands, for the help on the page and for the docs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from aero_viz.dashboard.panels.camera import MODES


@dataclass(frozen=True)
class Key:
    """A key of the page."""

    action: str
    """Action, for the program."""
    label: str
    """Description, for the user."""
    hotkey: Any
    """Name of the key in viser."""
    modifier: Any = None
    own: bool = False
    """True if it affects this visitor only, who then needs no control of the session."""
    argument: Any = None
    """Arguments of the action after the visitor."""
    also: str = ""
    """Another key with the same effect."""

    @property
    def shown(self) -> str:
        """Name of the key as in viser's palette of commands, and that of the other one."""
        modifiers = "" if self.modifier is None else self.modifier.replace("cmd/ctrl", "Ctrl").replace("shift", "Shift")
        name = f"{modifiers}+{self.hotkey}" if modifiers else self.hotkey
        return f"{name} or {self.also}" if self.also else name


_LAYERS = {
    "O": "obstacles", "C": "cloud", "R": "rollouts", "N": "anchors", "G": "guides", "X": "coarse_cells", "V": "samples"
}  # fmt: skip
KEYS: tuple[Key, ...] = (
    Key("play", "Play or pause", "space"),
    Key("step", "One tick back", ",", argument=-1, also="←"),
    Key("step", "One tick forward", ".", argument=1, also="→"),
    Key("step", "Ten ticks back", ",", "shift", argument=-10, also="Shift+←"),
    Key("step", "Ten ticks forward", ".", "shift", argument=10, also="Shift+→"),
    Key("undo", "Undo a change", "Z", "cmd/ctrl"),
    Key("redo", "Redo a change", "Z", "cmd/ctrl+shift"),
    Key("throw", "Throw an obstacle", "T"),
    Key("remove", "Remove the selected obstacle", "delete"),
    *(Key("camera", f"Camera: {mode}", f"{i}", own=True, argument=mode) for i, mode in enumerate(MODES, 1)),
    *(Key("layer", f"Layer: {name.replace('_', ' ')}", key, own=True, argument=name) for key, name in _LAYERS.items()),
    Key("theme", "Light or dark page", "L", own=True),
    Key("help", "Show or hide the keys", "?", "shift", own=True),
    Key("close", "Hide the keys", "escape", own=True),
)
LISTENER = """
if (!window.aeroKeys) {
  window.aeroKeys = true;
  addEventListener("keydown", event => {
    if (!event.isTrusted || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("input, textarea, select, [contenteditable]")) return;
    if (event.key === " ") event.target.closest("button")?.blur();
    const key = {ArrowLeft: ",", ArrowRight: "."}[event.key];
    if (!key || event.target.closest("[role=slider]")) return;
    event.stopImmediatePropagation();
    event.preventDefault();
    const options = {key, shiftKey: event.shiftKey, bubbles: true};
    document.documentElement.dispatchEvent(new KeyboardEvent("keydown", options));
  }, true);
  addEventListener("click", event => {
    if (event.target.matches("input[type=checkbox]") && event.detail > 0) event.target.blur();
  });
}
"""
"""Script for keys that the page would take otherwise.

The arrow keys step instead of turning the camera, the space bar presses no button, and a checkbox that was clicked
leaves the keys to the page.
"""


def rows() -> list[tuple[str, str]]:
    """Return each key and its effect."""
    return [(key.shown, key.label) for key in KEYS]
