"""Parameters: their description, the fields that declare them, and the base classes of every configuration.

The planner, the node on the drone and the simulator all declare their parameters in the same way: a section is a frozen
dataclass derived from `ParameterSection`, and a configuration of several sections derives from `SectionedConfig`.
Sliders, command line flags, YAML files and the documentation are generated from these declarations.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, get_type_hints

Value = float | int | bool | str
Config = TypeVar("Config", bound="SectionedConfig")


class ContradictionError(ValueError):
    """Parameters contradict each other.

    Args:
        message: names the parameters, their values and what must hold.
        *paths: paths of the parameters. A message about a file names the line of the first one that the file sets.
        line: line of this parameter, counted from 1; None if the message names none.

    Attributes:
        paths, line: see the arguments.
    """

    def __init__(self, message: str, *paths: str, line: int | None = None) -> None:
        super().__init__(message)
        self.paths, self.line = paths, line


@dataclass(frozen=True)
class ParameterInfo:
    """Description of one parameter."""

    section: str
    name: str
    default: Value
    unit: str
    help: str
    low: float = -math.inf
    high: float = math.inf
    scale: Literal["linear", "log"] = "linear"
    choices: tuple[str, ...] = ()
    live: bool = True
    """True if the value can change between two plans; a structural parameter rebuilds what depends on it."""
    symbol: str = ""
    """Symbol in the paper, such as "Q_p"."""
    label: str = ""
    """Name for people, such as "Goal position weight"; derived from `name` if empty."""
    group: str = ""
    """Heading under which a page shows the parameter; derived from `section` if empty."""
    basic: bool = False
    """True if the parameter is among the few that are tuned first."""
    pattern: str = ""
    """Regular expression that a text must match as a whole."""
    form: str = ""
    """The pattern in words, such as "an address"."""
    pack: Callable[[str], Any] | None = None
    """Function that returns the numbers of a text, an array of float32 that kernels read; None for another one."""
    items: tuple[str, ...] | None = None
    """Names of which a text lists any, separated by commas, in this order; None for another text."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "label", self.label or self.name.replace("_", " ").capitalize())
        object.__setattr__(self, "group", self.group or self.section.replace("_", " ").capitalize())

    @property
    def path(self) -> str:
        """Name with its section, such as "costs.q_track"."""
        return f"{self.section}.{self.name}"

    @property
    def title(self) -> str:
        """Label with symbol and unit, such as "Goal position weight Q_p [1/m]"."""
        unit = f"[{self.unit}]" if self.unit else ""
        return " ".join(part for part in (self.label, self.symbol, unit) if part)

    @property
    def is_number(self) -> bool:
        """True for a number, false for a switch, a choice or a text."""
        return not isinstance(self.default, bool | str)

    @property
    def accepts_nothing(self) -> bool:
        """True for a text that may be empty."""
        return self.items is not None or (bool(self.pattern) and re.fullmatch(self.pattern, "") is not None)

    @property
    def range(self) -> str:
        """Allowed values in words: the choices, the bounds with their unit, or the form of a text."""
        if self.form or self.choices:
            return self.form or ", ".join(self.choices)
        if isinstance(self.default, bool):
            return "true, false"
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()

    def check(self, value: Any) -> Value:
        """Return `value` converted to the type of this parameter.

        NumPy scalars count as numbers, and 128.0 counts as a whole number.

        Raises:
            ValueError: the value has the wrong type or is out of bounds; names parameter, value and range.
        """
        kind = type(self.default)
        if self.items is not None:
            return self._check_items(value, self.items)
        if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
            value = value.item()
        if self.pattern:
            valid, expected = isinstance(value, str) and re.fullmatch(self.pattern, value) is not None, self.form
        elif self.choices:
            valid, expected = isinstance(value, str) and value in self.choices, f"one of {', '.join(self.choices)}"
        elif kind is bool:
            valid, expected = isinstance(value, bool), "true or false"
        else:
            valid = isinstance(value, int | float) and not isinstance(value, bool)
            valid = valid and self.low <= value <= self.high and (kind is float or value == int(value))
            number = "a whole number" if kind is int else "a number"
            expected = f"{number} in [{self.low:g}, {self.high:g}] {self.unit}".rstrip()
        if not valid:
            raise ValueError(f"{self.path} is {value!r}; it must be {expected}.")
        return kind(value)

    def _check_items(self, value: Any, items: tuple[str, ...]) -> str:
        """Return the names that a text lists in the order of `items`, separated by commas."""
        if not isinstance(value, str):
            raise ValueError(f"{self.path} is {value!r}; it must be {self.form}.")
        listed = {name.strip() for name in value.split(",")} - {""}
        for name in sorted(listed.difference(items)):
            hint = did_you_mean(name, items)
            raise ValueError(f"{self.path} has {name!r}{hint}; known: {', '.join(items) or 'none'}.")
        return ", ".join(name for name in items if name in listed)


def live(default: Any, unit: str, low: float, high: float, help: str, **more: Any) -> Any:
    """Return the field of a number that can change between two plans.

    Args:
        default, unit, low, high, help: as in `ParameterInfo`.
        **more: `label`, `group`, `symbol`, `scale` and `basic`, as in `ParameterInfo`.
    """
    return _field(default, unit=unit, low=low, high=high, help=help, **more)


def structural(default: int, low: float, high: float, help: str, **more: Any) -> Any:
    """Return the field of a whole number that sizes buffers; arguments as for `live`."""
    return _field(default, unit="", low=low, high=high, help=help, live=False, **more)


def switch(default: bool, help: str, **more: Any) -> Any:
    """Return the field of a boolean; `live=False` makes it structural, other arguments as for `live`."""
    return _field(default, unit="", help=help, low=0.0, high=1.0, **more)


def choice(default: str, choices: tuple[str, ...], help: str, **more: Any) -> Any:
    """Return the field of a value out of several named ones; other arguments as for `live`."""
    return _field(default, unit="", help=help, choices=choices, **more)


def text(default: str, pattern: str, form: str, help: str, **more: Any) -> Any:
    """Return the field of a text that matches `pattern`; `form` describes the pattern in words."""
    return _field(default, unit="", help=help, pattern=pattern, form=form, live=False, **more)


def table(default: str, pattern: str, form: str, pack: Callable[[str], Any], help: str, **more: Any) -> Any:
    """Return the field of a text of numbers that can change between two plans; `pack` as in `ParameterInfo`."""
    return _field(default, unit="", help=help, pattern=pattern, form=form, pack=pack, **more)


def names_list(default: str, items: tuple[str, ...], help: str, **more: Any) -> Any:
    """Return the field of a text that lists any of `items`, separated by commas."""
    return _field(default, unit="", help=help, items=items, form="names separated by commas", live=False, **more)


def _field(default: Value, **description: Any) -> Any:
    return field(default=default, metadata={"default": default, **description})


@dataclass(frozen=True)
class ParameterSection:
    """Base of a section of parameters: a frozen dataclass that checks its values when it is created.

    Fields made by `live`, `structural`, `switch`, `choice`, `text`, `table` or `names_list` are parameters, others not.
    The name of the section is a class argument: `class CostConfig(ParameterSection, section="costs")`.

    Raises:
        ValueError: a parameter has the wrong type or is out of bounds; names parameter, value and range.
    """

    section: ClassVar[str]

    def __init_subclass__(cls, *, section: str, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.section = section

    def __post_init__(self) -> None:
        for info in self.parameters():
            object.__setattr__(self, info.name, info.check(getattr(self, info.name)))

    def sweep_memory(self, speed_limit: float) -> float | None:
        """Return for how long a stage with these parameters wants sweeps to be remembered at a speed limit [m/s], in
        seconds; None if it does not care.
        """
        return None

    @classmethod
    @functools.cache
    def parameters(cls) -> tuple[ParameterInfo, ...]:
        """Return the parameters of the section, in the order of its fields."""
        return tuple(
            ParameterInfo(section=cls.section, name=field.name, **field.metadata)
            for field in dataclasses.fields(cls)
            if field.metadata
        )


@dataclass(frozen=True)
class SectionedConfig:
    """Base of a configuration that consists of sections: a frozen dataclass whose fields are `ParameterSection`s.

    Raises:
        ValueError: a section is of the wrong type, or a parameter such as `range_min` is not below `range_max`.
    """

    noun: ClassVar[str] = "parameter"
    """Word for a parameter in error messages."""
    listing: ClassVar[str] = "aero-viz parameters"
    """Command that lists all parameters."""
    renamed: ClassVar[Mapping[str, str]] = {}
    """New path of each parameter by its old path, which remains valid for one release."""
    changed: ClassVar[Mapping[str, str]] = {}
    """What is different about a renamed parameter, by its old path: the end of "is now .., which .."."""
    removed: ClassVar[Mapping[str, str]] = {}
    """Reason by the path of a removed parameter, whose value is ignored for one release."""

    if TYPE_CHECKING:  # for sections that `with_sections` adds

        def __getattr__(self, name: str) -> Any: ...

    def __post_init__(self) -> None:
        for name, section in self.sections().items():
            if not isinstance(getattr(self, name), section):
                raise ValueError(f"section {name!r} is {getattr(self, name)!r}; it must be a {section.__name__}.")
        for path_min, path_max in self._limits():
            low, high = float(self.get(path_min)), float(self.get(path_max))
            if low >= high:
                message = f"{path_min} is {low}; it must be less than {path_max}, which is {high}."
                raise ContradictionError(message, path_min, path_max)

    @classmethod
    @functools.cache
    def _limits(cls) -> tuple[tuple[str, str], ...]:
        """Return the paths of each pair of parameters such as `range_min` and `range_max`."""
        pairs = ((path, path[: -len("min")] + "max") for path in cls._by_path() if path.endswith("_min"))
        return tuple((low, high) for low, high in pairs if high in cls._by_path())

    @classmethod
    @functools.cache
    def sections(cls) -> dict[str, type[ParameterSection]]:
        """Return the class of each section by name, in the order of the fields."""
        types = get_type_hints(cls)
        return {field.name: types[field.name] for field in dataclasses.fields(cls)}

    @classmethod
    @functools.cache
    def parameters(cls) -> tuple[ParameterInfo, ...]:
        """Return every parameter, section by section."""
        return tuple(info for section in cls.sections().values() for info in section.parameters())

    @classmethod
    @functools.cache
    def _by_path(cls) -> dict[str, ParameterInfo]:
        return {info.path: info for info in cls.parameters()}

    @classmethod
    def check_section(cls, name: Any) -> None:
        """Raise ValueError, with the nearest known name, if there is no section `name`, and there was none."""
        known = cls.sections()
        earlier = {path.partition(".")[0] for path in (*cls.renamed, *cls.removed)}
        if name not in known and name not in earlier:
            raise ValueError(f"unknown section {name!r}{did_you_mean(name, known)}; known: {', '.join(known)}.")

    @classmethod
    def find(cls, path: str) -> ParameterInfo:
        """Return the parameter at `path`, such as "costs.q_track".

        Raises:
            ValueError: there is no such parameter; the message suggests the nearest one.
        """
        known = cls._by_path()
        path = cls.renamed.get(path, path)
        if path not in known:
            if path in cls.removed:
                raise ValueError(f"{path} was removed: {cls.removed[path]}.")
            # Only names are compared: the right name in the wrong section, or in none, is near, and another name in the
            # right section is not.
            section, _, name = str(path).rpartition(".")
            nearest = _nearest(name, (info.name for info in known.values()))
            same_name = sorted((i for i in known.values() if i.name == nearest), key=lambda i: i.section != section)
            hint = _suggest(same_name[0].path if same_name else None)
            raise ValueError(f"unknown {cls.noun} {path!r}{hint}; {cls.listing} lists all.")
        return known[path]

    @classmethod
    def current_path(cls, path: str, source: str = "") -> str | None:
        """Return the current path of a parameter, or None if it was removed; logs a notice if `path` is an old one.

        Args:
            path: current or old path of a parameter, or any other text, which is returned as it is.
            source: beginning of the notice, such as "tuned.yaml, line 3: ".
        """
        if path in cls.renamed:
            new = ", which ".join((cls.renamed[path], *([cls.changed[path]] if path in cls.changed else [])))
            log_warning("%s%s is now %s; the old name works until the next release.", source, path, new)
            return cls.renamed[path]
        if path in cls.removed:
            log_warning("%s%s is ignored: %s.", source, path, cls.removed[path])
            return None
        return path

    def replace(self: Config, changes: Mapping[str, Value] | None = None, /, **sections: Any) -> Config:
        """Return a copy with the parameters of `changes`, keyed by path, such as {"costs.q_track": 5.0}.

        Raises:
            ValueError: a path names no parameter (the message suggests the nearest one); see also the class.
        """
        grouped: dict[str, dict[str, Any]] = {}
        for path, value in (changes or {}).items():
            current = self.current_path(path)
            if current is not None:
                info = self.find(current)
                grouped.setdefault(info.section, {})[info.name] = value
        for section, values in grouped.items():
            sections[section] = dataclasses.replace(sections.get(section, getattr(self, section)), **values)
        return dataclasses.replace(self, **sections)

    def get(self, path: str) -> Value:
        """Return the value of the parameter at `path`, such as "costs.q_track"; raises ValueError like `find`."""
        info = self.find(path)
        return getattr(getattr(self, info.section), info.name)

    def differences(self: Config, other: Config) -> dict[str, tuple[Value, Value]]:
        """Return the values of each parameter that differs, by path: of this configuration and of the other one.

        Parameters that only one of them has, because it is for another planner, are left out.
        """
        shared = {info.path for info in other.parameters()}
        pairs = {p: (self.get(p), other.get(p)) for p in (info.path for info in self.parameters()) if p in shared}
        return {path: pair for path, pair in pairs.items() if pair[0] != pair[1]}

    def to_dict(self) -> dict[str, dict[str, Value]]:
        """Return {section: {name: value}}, the structure of the YAML file."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls: type[Config], values: Mapping[str, Mapping[str, Value]]) -> Config:
        """Return the default configuration with the parameters of `values`, {section: {name: value}}.

        Raises:
            ValueError: a section or name is unknown (the message suggests the nearest one); see also the class.
        """
        if not isinstance(values, Mapping):
            raise ValueError(f"the configuration is {values!r}; it must hold sections: {', '.join(cls.sections())}.")
        changes: dict[str, Value] = {}
        for section, content in values.items():
            cls.check_section(section)
            if not isinstance(content, Mapping):
                raise ValueError(f"section {section!r} is {content!r}; it must hold names and values.")
            changes.update({f"{section}.{name}": value for name, value in content.items()})
        return cls().replace(changes)


def with_sections(sections: Mapping[str, type[ParameterSection]]) -> Callable[[type[Config]], type[Config]]:
    """Return a decorator that makes a class a frozen dataclass with its own fields and those of `sections`, by name."""

    def decorate(config: type[Config]) -> type[Config]:
        for name, section in sections.items():
            if name in config.__annotations__:
                raise ValueError(f"there is a section {name!r} already; give that of {section.__name__} another name.")
            config.__annotations__[name] = section
            setattr(config, name, field(default_factory=section))
        return dataclass(frozen=True)(config)

    return decorate


def log_warning(message: str, *values: str) -> None:
    """Log a warning, which reaches stderr unless logging is configured otherwise."""
    import logging  # imported here because it would add a quarter to the import time of this package

    logging.getLogger(__name__).warning(message, *values)


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """Return " (did you mean ..?)" with the known name nearest to `name`, or "" if none is near."""
    return _suggest(_nearest(name, known))


def _nearest(name: Any, known: Iterable[str]) -> str | None:
    """Return the known name nearest to `name`, or None if none is near."""
    return next(iter(difflib.get_close_matches(str(name), list(known), n=1)), None)


def _suggest(name: str | None) -> str:
    """Return the hint at a name for the end of an error's first clause, or "" for None."""
    return f" (did you mean {name!r}?)" if name is not None else ""
