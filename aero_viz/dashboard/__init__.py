"""The page: layers that draw frames, and panels that control the session. Only this package imports viser."""

from __future__ import annotations

from aero_viz.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
