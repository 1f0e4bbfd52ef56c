"""Methods of an object that only one thread at a time may call, and none once the object is closed."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


_PATIENCE = 5.0
"""Longest wait for another thread [s]; a plan takes milliseconds."""


class Use:
    """The use of an object by one thread, as a context; its methods may call each other.

    Args:
        name: what the object is, for messages.
    """

    def __init__(self, name: str) -> None:
        self._is_over = False
        self._name = name
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        """Begin.

        Raises:
            RuntimeError: another thread uses the object, or it is closed.
        """
        if not self._lock.acquire(blocking=False):
            raise RuntimeError(
                f"another thread is using this {self._name}; give each thread its own, or a lock to take turns."
            )
        if self._is_over:
            self._lock.release()
            raise RuntimeError(f"this {self._name} is closed; create another one.")

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    def end(self) -> None:
        """Close the object, as soon as another thread that uses it is done, but after `_PATIENCE` in any case."""
        self._is_over = True
        if self._lock.acquire(timeout=_PATIENCE):
            self._lock.release()


class Exclusive(Protocol):
    """An object with such methods."""

    _use: Use


_Self = TypeVar("_Self", bound=Exclusive)


def exclusive(
    method: Callable[Concatenate[_Self, _Arguments], _Result],
) -> Callable[Concatenate[_Self, _Arguments], _Result]:
    """Return a method that raises a RuntimeError while another thread is in one of its kind, see `Use`."""

    @functools.wraps(method)
    def call(self: Any, /, *arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        with self._use:
            return method(self, *arguments, **options)

    return call
