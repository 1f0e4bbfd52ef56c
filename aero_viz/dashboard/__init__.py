"""The page: layers that draw frames, and panels that control the session. Only this package imports viser."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aero_planner.lazy_import import lazy_exports

if TYPE_CHECKING:
    from aero_viz.dashboard.dashboard import Dashboard
    from aero_viz.dashboard.server import LocalServer

__all__ = ["Dashboard", "LocalServer"]

__getattr__, __dir__ = lazy_exports(__name__, {"dashboard": ("Dashboard",), "server": ("LocalServer",)})
