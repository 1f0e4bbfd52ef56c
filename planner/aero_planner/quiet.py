"""Warp without words: on the command line stdout belongs to the results."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

import warp as wp

__all__ = ["quieten", "start_warp"]


def quieten() -> None:
    """Keep Warp from reporting its start and the modules that it loads, unless another level of its log was chosen."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING


def start_warp() -> None:
    """Start Warp for a command line: quietly, and without its complaint about a missing GPU, no news to a CPU user."""
    quieten()
    with _no_stderr():
        wp.init()


@contextlib.contextmanager
def _no_stderr() -> Iterator[None]:
    """Keep what native code writes to stderr off the terminal."""
    sys.stderr.flush()
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)
