"""View of a page: its size, and what its browser has stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class PageView:
    """Size and state of a page."""

    size: tuple[int, int] = (1280, 720)
    """Width and height [pixels]."""
    storage: Mapping[str, str] = field(default_factory=dict)
    """Items of the browser's local storage."""
    is_ready: str = ""
    """JavaScript condition that holds once the page may be shown; empty waits for the first plan."""
