"""The visitors of the page, and which of them holds control."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Visitors:
    """One visitor holds control; the others watch until they take it. Safe to use from any thread.

    The first visitor who may hold control gets it. When the holder leaves, it passes to whoever has been here longest.
    """

    def __init__(self) -> None:
        self.on_change: Callable[[], None] = lambda: None
        """Called after a visitor has come, gone or taken control."""
        self._may_control: dict[int, bool] = {}
        """By the number of the client in viser, in the order of arrival."""
        self._excluded: set[int] = set()
        self._holder: int | None = None
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of visitors."""
        return len(self._may_control)

    def has_control(self, number: int) -> bool:
        """Return True if a visitor holds control."""
        return self._holder == number

    def may_control(self, number: int) -> bool:
        """Return True if a visitor holds control or may take it."""
        return self._may_control.get(number, False)

    def is_present(self, number: int) -> bool:
        """Return True if a visitor has joined and not left."""
        return number in self._may_control

    def join(self, number: int, *, may_control: bool) -> None:
        """Add a visitor who has not joined yet."""
        if number not in self._may_control and number not in self._excluded:
            with self._lock:
                self._may_control[number] = may_control
                self._appoint()
            self.on_change()

    def exclude(self, number: int) -> None:
        """Remove a page that belongs to no person, and does not join again."""
        self._excluded.add(number)
        self._remove(number)

    def leave(self, number: int) -> None:
        """Remove a visitor."""
        self._excluded.discard(number)
        self._remove(number)

    def _remove(self, number: int) -> None:
        if number in self._may_control:
            with self._lock:
                self._may_control = {other: may for other, may in self._may_control.items() if other != number}
                self._appoint()
            self.on_change()

    def take_control(self, number: int) -> bool:
        """Give control to a visitor who may have it; return False if this one may not."""
        with self._lock:
            if not self.may_control(number):
                return False
            self._holder = number
        self.on_change()
        return True

    def _appoint(self) -> None:
        if self._holder not in self._may_control:
            self._holder = next((number for number, may in self._may_control.items() if may), None)
