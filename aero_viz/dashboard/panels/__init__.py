"""The control panel, one module per part."""

from __future__ import annotations

from aero_viz.dashboard.panels.base import Page, Panel

__all__ = ["Page", "Panel"]
