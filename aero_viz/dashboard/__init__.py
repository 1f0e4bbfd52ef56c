"""The page: layers that draw frames, panels that steer the session. The only package that knows viser."""

from __future__ import annotations

from aero_viz.dashboard.dashboard import Dashboard

__all__ = ["Dashboard"]
