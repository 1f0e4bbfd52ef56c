from __future__ import annotations

from tests.planner.conftest import device

__all__ = ["device"]
