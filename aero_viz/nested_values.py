"""Values in nested dictionaries, such as settings by section."""

from __future__ import annotations

from typing import Any


def leaves_by_path(value: Any, path: str = "") -> dict[str, Any]:
    """Return the leaves of nested dictionaries by path, such as {"drone.mass": 1.0}.

    Args:
        value: dictionary with names as keys, or a leaf.
        path: path of `value` itself; empty for the root.
    """
    if not isinstance(value, dict):
        return {path: value}
    return {
        leaf_path: leaf
        for name, child in value.items()
        for leaf_path, leaf in leaves_by_path(child, f"{path}.{name}" if path else name).items()
    }
