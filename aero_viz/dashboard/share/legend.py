"""The legend of a recording, whose values change with the time that is shown."""

from __future__ import annotations

from collections.abc import Iterable

from aero_viz.dashboard.layers import ColorKey, ColorScale, Layer, legend_entries
from aero_viz.session.frame import Frame


class RecordedLegend:
    """The meaning of all colours that are drawn at any tick, and the ends of the colour scales at each tick."""

    def __init__(self) -> None:
        self._entries: dict[str, dict[str, ColorKey | ColorScale]] = {}
        """The first entry of each label, by layer."""
        self._ends: list[dict[str, tuple[str, str]]] = []
        """Texts at both ends of each scale, by its label, one table for each tick."""

    def add(self, layers: Iterable[Layer], frame: Frame) -> None:
        """Add what the layers draw at a tick."""
        ends: dict[str, tuple[str, str]] = {}
        for layer in layers:
            known = self._entries.setdefault(layer.name, {})
            for entry in legend_entries([layer], frame):
                known.setdefault(entry.label, entry)
                if isinstance(entry, ColorScale):
                    ends[entry.label] = (entry.low, entry.high)
        self._ends.append(ends)

    @property
    def entries(self) -> list[ColorKey | ColorScale]:
        """The entries, in the order of the layers; scales have the values of the first tick that shows them."""
        return [entry for known in self._entries.values() for entry in known.values()]

    @property
    def ends(self) -> list[list[tuple[str, str]]]:
        """Texts at both ends of each scale among the entries, one row for each tick; empty while it is not drawn."""
        labels = [entry.label for entry in self.entries if isinstance(entry, ColorScale)]
        return [[ends.get(label, ("", "")) for label in labels] for ends in self._ends]
