"""The control panel, one module per part."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.dashboard.panels.base import Page, Panel
    from aero_viz.dashboard.panels.layout import PANELS

__all__ = ["PANELS", "Page", "Panel"]

__getattr__, __dir__ = lazy_exports(__name__, {"base": ("Page", "Panel"), "layout": ("PANELS",)})
