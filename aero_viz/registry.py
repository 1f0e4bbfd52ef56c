"""Parts of the workbench by name: those that ship, those of installed distributions, and any one as "module:attribute".

Every kind of part has one `Registry`, and all of them are asked in the same way. A distribution brings a part by an
entry point in the group of its kind, a script by `add`. Entry points are read when a name is asked for that does not
ship, and imported when they are needed. One that cannot be imported is named once, with its error, and left out.
"""

from __future__ import annotations

import importlib
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from typing import Any, TypeVar

from aero_planner.parameters import did_you_mean
from aero_planner.plain_text import one_line
from aero_planner.registry import PlugIn, find_attribute, plug_ins
from aero_viz.errors import UserError

T = TypeVar("T")
R = TypeVar("R")
_PLACE = re.compile(r"[^\W\d][\w.]*:[^\W\d][\w.]*")
_log = logging.getLogger(__name__)


def is_place(text: str) -> bool:
    """Return True if a text can be the place of a part, "module:attribute"."""
    return _PLACE.fullmatch(text) is not None


class Registry(Mapping[str, T]):
    """The parts of one kind, by name: those that ship, whose names nothing else can take, and then those brought.

    A name that is not registered is no key. Iteration leaves out what cannot be imported; asking for it by its name is
    an error that says why.

    Args:
        kind: what the parts are, for messages, such as "scene".
        group: group of the entry points.
        shipped: the parts that ship, or their places "module:attribute".
        accept: returns the part for a name and an object that was brought; raises UserError if it is none.
        others: what else a user may give, for messages.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        shipped: Mapping[str, T | str],
        accept: Callable[[str, Any], T],
        *,
        others: str = "module:attribute",
    ) -> None:
        self.kind, self.group, self.shipped = kind, group, shipped
        self._accept, self._others = accept, others
        self._added: dict[str, T] = {}
        self._loaded: dict[str, T] = {}
        self._problems: dict[str, str] = {}
        self._named: set[str] = set()
        """Places that this process was asked to import."""

    @cached_property
    def _brought(self) -> dict[str, PlugIn]:
        """What entry points bring, by name; the first one of a name counts."""
        found: dict[str, PlugIn] = {}
        for plug_in in plug_ins(self.group):
            if plug_in.name in self.shipped or plug_in.name in self._added or plug_in.name in found:
                _log.warning("%s", self._is_taken(plug_in))
            else:
                found[plug_in.name] = plug_in
        return found

    def _is_taken(self, plug_in: PlugIn) -> str:
        return (
            f"The {self.kind} {plug_in.name} of {plug_in.distribution} is left out: there is one of that name already; "
            "rename its entry point."
        )

    def add(self, name: str, part: Any) -> None:
        """Add a part to those of this process.

        Args:
            name: its name, which no other one has.
            part: what an entry point would refer to.

        Raises:
            ValueError: the name is taken.
            UserError: it is no part of this kind.
        """
        if name in self:
            raise ValueError(f"There is a {self.kind} {name!r} already; give another name.")
        self._added[name] = self._accept(name, part)

    def names(self) -> tuple[str, ...]:
        """Return the names of all parts, without importing any."""
        return (*self.shipped, *self._added, *self._brought)

    def __contains__(self, name: object) -> bool:
        return name in self.shipped or name in self._added or name in self._named or name in self._brought

    def __iter__(self) -> Iterator[str]:
        yield from self.shipped
        yield from self._added
        for name in self._brought:
            if not self.problem(name):
                yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __getitem__(self, name: str) -> T:
        if name not in self:
            raise KeyError(name)
        if problem := self._problems.get(name):
            raise UserError(problem)
        if name not in self._loaded:
            try:
                self._loaded[name] = self._load(name)
            except UserError as error:
                self._problems[name] = str(error)
                raise
            except (Exception, SystemExit) as error:  # whatever a brought module raises
                reason = f"{type(error).__name__}: {one_line(error).rstrip('.')}"
                self._problems[name] = f"The {self.kind} {name} cannot be imported: {reason}."
                raise UserError(self._problems[name]) from error
        return self._loaded[name]

    def _load(self, name: str) -> T:
        if name in self._added:
            return self._added[name]
        if name in self.shipped:
            part: Any = self.shipped[name]
            return self._accept(name, find_attribute(part)) if isinstance(part, str) else part
        if name in self._brought:
            return self._accept(name, find_attribute(self._brought[name].place))
        _import_also_from_here(name.partition(":")[0])
        return self._accept(name, find_attribute(name))

    def problem(self, name: str) -> str:
        """Return why a part cannot be imported, and log it the first time; empty if it can."""
        is_new = name not in self._problems
        try:
            self[name]
        except UserError as error:
            if is_new:
                _log.warning("%s", error)
            return str(error)
        return ""

    def made(self, name: str, make: Callable[[T], R]) -> R | None:
        """Return what is made of a part; None for one that was brought and fails, which is logged with its error."""
        try:
            return make(self[name])
        except Exception as error:  # whatever a brought part raises
            if name in self.shipped:
                raise
            _log.warning("The %s %s is left out: %s: %s", self.kind, name, type(error).__name__, one_line(error))
            return None

    def load(self, name: str) -> T:
        """Return the part that a user names on the command line or in a program: by its name, or by its place.

        The module of a place is imported, also from the current folder.

        Raises:
            UserError: there is no such part, or it cannot be imported; says why.
        """
        if name not in self and is_place(name):
            self._named.add(name)
        return self.known(name)

    def admit(self, name: str) -> str:
        """Import the part at a place that a user names on the command line; return the name, whatever it is.

        Raises:
            UserError: it is the place of a part that cannot be imported.
        """
        if is_place(name) and not os.path.exists(name):
            self.load(name)
        return name

    def known(self, name: str) -> T:
        """Return the part that a file, a link or a page names: it may not choose which modules are imported.

        Raises:
            UserError: there is no such part, or it cannot be imported; says why.
        """
        if name not in self:
            names = self.names()
            raise UserError(
                f"There is no {self.kind} {name!r}{did_you_mean(name, names)}; give one of {', '.join(names)}, or "
                f"{self._others}."
            )
        return self[name]

    def name_of(self, place: str) -> str:
        """Return the name of the part at a place, or the place."""
        places = {**self.shipped, **{name: plug_in.place for name, plug_in in self._brought.items()}}
        return next((name for name, part in places.items() if part == place), place)

    def plug_ins(self) -> list[tuple[PlugIn, str]]:
        """Return what entry points bring, each with the reason why it is left out, or ""; all are imported."""
        return [
            (
                plug_in,
                self.problem(plug_in.name) if self._brought.get(plug_in.name) == plug_in else self._is_taken(plug_in),
            )
            for plug_in in plug_ins(self.group)
        ]


def _import_also_from_here(module: str) -> None:
    """Import a module that was named on purpose, also from the current folder."""
    try:
        importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        sys.path.append(os.getcwd())
        try:
            importlib.import_module(module)
        finally:
            sys.path.remove(os.getcwd())
