"""YAML files of strangers: their nodes are looked at, and nothing but plain values is made of them.

Merge keys and aliases let a small text expand without end when it is constructed as a whole.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import yaml

_DEPTH_MAX = 20
_LENGTH_MAX = 200
"""Longest text or list of a plain value."""


def compose_yaml(text: str) -> yaml.Node | None:
    """Return the root node of a text, None if it is empty.

    Raises:
        ValueError: it is not YAML, or is nested too deeply; the text completes the sentence "FILE is ..".
    """
    loader, depth = getattr(yaml, "CSafeLoader", yaml.SafeLoader), 0
    try:
        for event in yaml.parse(text, loader):  # composing nodes that are nested too deeply overflows libyaml's stack
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _DEPTH_MAX:
                raise ValueError(f"nested more than {_DEPTH_MAX} deep")
        return yaml.compose(text, loader)
    except yaml.YAMLError as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())[:200]}") from error


def load_yaml(text: str) -> Any:
    """Return the content of a text without aliases; None if it is empty.

    Raises:
        ValueError: as for `compose_yaml`, or it has aliases.
    """
    compose_yaml(text)
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, yaml.SafeLoader)):
        raise ValueError("YAML with aliases, which are not read; write the values themselves")
    try:
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"not YAML: {' '.join(str(error).split())[:200]}") from error


def plain_values(text: str, keys: Collection[str]) -> dict[str, Any]:
    """Return those of the keys that the outermost mapping of a text has, with their plain values or lists of them.

    Everything else is left out, merge keys included.

    Raises:
        ValueError: as for `compose_yaml`, or one of the values is no such value.
    """
    root = compose_yaml(text)
    pairs = root.value if isinstance(root, yaml.MappingNode) else []
    return {key.value: _plain(value, key.value) for key, value in pairs if key.value in keys}


def _plain(node: yaml.Node, key: str) -> Any:
    items = node.value if isinstance(node, yaml.SequenceNode) else [node]
    is_plain = all(isinstance(item, yaml.ScalarNode) and len(item.value) <= _LENGTH_MAX for item in items)
    if not is_plain or len(items) > _LENGTH_MAX:
        raise ValueError(f"damaged: the value of {key} must be a number, a text or a short list of them")
    try:
        values = [yaml.SafeLoader("").construct_object(item) for item in items]
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"damaged: the value of {key} is not understood") from error
    return values if isinstance(node, yaml.SequenceNode) else values[0]
