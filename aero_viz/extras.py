"""The optional dependencies: what a command says when one of them is not installed."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from aero_viz.errors import UserError


@contextlib.contextmanager
def from_extra(extra: str, purpose: str) -> Iterator[None]:
    """Say which extra is missing if a package cannot be imported in the body of this context.

    Args:
        extra: name of the extra in pyproject.toml, such as "formats".
        purpose: what needs the package, such as "Pictures" or the path of a file.

    Raises:
        UserError: the package cannot be imported; says what needs it and how to install it.
    """
    try:
        yield
    except ImportError as error:
        raise UserError(f"{purpose} {how_to_install(extra)} ({error}).") from error


def how_to_install(extra: str) -> str:
    """Return what is needed, and the command that installs it."""
    return f"need the extra {extra!r}: run pip install '.[{extra}]' in the checkout of AERO-Viz"
