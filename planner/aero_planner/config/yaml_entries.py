"""Parse the text of a configuration file into keys and values, each with its line for error messages.

PyYAML parses the text. Forms of YAML that have no meaning in a configuration are refused: lists, mappings in braces,
anchors, tags, several documents. Values that versions of YAML read differently (010, 1_000, yes) remain strings, which
are not valid as numbers or switches; 1e5 is a number.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, NoReturn

import yaml

from aero_planner.parameters import Value

_MAX_DEPTH = 8
_DIGITS_MAX = 300
"""Longest text of an integer. A longer one is no float, and out of all bounds."""
_HINT = "write 'section:' or, indented by two spaces, 'name: value'"
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
_BOOLEANS = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}


@dataclass(frozen=True)
class Entry:
    """A key with its value, with the entries on the lines below it, or with neither."""

    key: str
    line: int
    """Line number, counted from 1."""
    value: Value | None = None
    entries: tuple[Entry, ...] = ()


def parse_entries(text: str, path: str) -> tuple[Entry, ...]:
    """Return the top-level entries of the text of a configuration file.

    Raises:
        ValueError: the text is not YAML, has a form of YAML that is refused, or repeats a key; the message begins with
            `path` and the line.
    """
    return _Parser(text, path).parse()


class _Loader(yaml.SafeLoader):
    """Composes the nodes of one document without anchors, aliases and tags."""

    depth = 0

    def compose_document(self) -> yaml.Node | None:
        event = self.peek_event()
        if event.explicit:
            raise yaml.MarkedYAMLError(problem="a configuration is a single document", problem_mark=event.start_mark)
        return super().compose_document()

    def compose_node(self, parent: Any, index: Any) -> yaml.Node | None:
        event = self.peek_event()
        if event.anchor is not None or getattr(event, "tag", None) is not None:
            problem = "anchors, aliases and tags are not supported"
        elif self.depth >= _MAX_DEPTH:
            problem = "it is nested too deeply"
        else:
            self.depth += 1
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


class _Parser:
    def __init__(self, text: str, path: str) -> None:
        self._text = text
        self._path = path

    def parse(self) -> tuple[Entry, ...]:
        try:
            root = yaml.compose(self._text, _Loader)
        except yaml.reader.ReaderError as error:
            line = self._text.count("\n", 0, error.position)
            self._fail(line, f"there is the character {chr(error.character)!r}; give a configuration file.")
        except yaml.MarkedYAMLError as error:
            self._fail_syntax(error)
        return () if root is None else self._entries(root)

    def _entries(self, node: yaml.Node, parents: tuple[str, ...] = ()) -> tuple[Entry, ...]:
        if not isinstance(node, yaml.MappingNode) or node.flow_style:
            self._fail_unknown(node.start_mark.line)
        entries: dict[str, Entry] = {}
        for key, content in node.value:
            line, column = key.start_mark.line, key.start_mark.column
            if not isinstance(key, yaml.ScalarNode):
                self._fail_unknown(line)
            if column and not parents:
                self._fail(line, f"{key.value!r} belongs to no section; start one with a line such as 'costs:'.")
            if column != 2 * len(parents):
                self._fail(line, f"{key.value!r} is indented by {column} spaces; use {2 * len(parents)}.")
            path = (*parents, key.value)
            if key.value in entries:
                self._fail(line, f"{'.'.join(path)} is given twice; keep it in one place.")
            entries[key.value] = self._entry(path, line, content)
        return tuple(entries.values())

    def _entry(self, path: tuple[str, ...], line: int, content: yaml.Node) -> Entry:
        key = path[-1]
        if isinstance(content, yaml.MappingNode) and not content.flow_style:
            return Entry(key, line + 1, entries=self._entries(content, path))
        if content.start_mark.line != line:
            self._fail_unknown(content.start_mark.line)
        if isinstance(content, yaml.ScalarNode):
            return Entry(key, line + 1, _scalar(content))
        # A list or a mapping in braces is the value of no parameter; its text appears in the error message.
        text = self._text[content.start_mark.index : content.end_mark.index]
        return Entry(key, line + 1, " ".join(text.split())[:80])

    def _fail_syntax(self, error: yaml.MarkedYAMLError) -> NoReturn:
        is_quote = error.context == "while scanning a quoted scalar"
        mark = error.context_mark if is_quote else error.problem_mark
        line = 0 if mark is None else mark.line
        if is_quote:
            self._fail(line, f"{self._line(line)!r} has no matching quote at its end.")
        if "'\\t'" in (error.problem or ""):
            self._fail(line, "there is a tab; use spaces.")
        self._fail_unknown(line, f" ({error.problem})")

    def _fail_unknown(self, line: int, problem: str = "") -> NoReturn:
        self._fail(line, f"{self._line(line)!r} is not understood{problem}; {_HINT}.")

    def _fail(self, line: int, message: str) -> NoReturn:
        raise ValueError(f"{self._path}, line {line + 1}: {message}")

    def _line(self, line: int) -> str:
        lines = self._text.splitlines()
        return lines[line].strip()[:80] if line < len(lines) else ""


def _scalar(node: yaml.ScalarNode) -> Value | None:
    """Return a scalar as a person reads it: a boolean, a number or a string; None if it is empty."""
    text = node.value
    if node.style is not None:  # quoted
        return text
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if _INTEGER.fullmatch(text):
        return int(text) if len(text) <= _DIGITS_MAX else math.inf
    if _FLOAT.fullmatch(text):
        return float(text)
    return text or None
