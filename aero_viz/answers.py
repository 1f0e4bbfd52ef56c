"""The answers of a process that reads files: plain values, NumPy's arrays, and our own records of them, as MessagePack.

A file may have taken over the process. So an answer is data: it calls nothing but the constructors of our dataclasses,
enumerations and named tuples, which check what they are given.
"""

from __future__ import annotations

import array
import dataclasses
import enum
import functools
import importlib
import io
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

_PACKAGES = ("aero_planner", "aero_viz")
_PLAIN = frozenset((type(None), bool, float, str, bytes))
_INTEGERS = range(-(2**63), 2**64)
"""Integers that MessagePack knows."""
_LENGTH_BYTES = 8
_Pack = Callable[[Any], Any]


class AnswerError(ValueError):
    """An answer is damaged, too large, or names something else than values."""


def encode(value: Any, files: Sequence[Any] = ()) -> bytes:
    """Return the text of a value.

    Args:
        value: plain values, arrays, and our records, in lists, tuples, sets and mappings.
        files: objects that stay where they are: each stands in the text as its place in this list.

    Raises:
        TypeError: the value holds something else.
    """

    def pack(value: Any) -> Any:
        kind = type(value)
        if kind in _PLAIN or (kind is int and value in _INTEGERS):
            return value
        if kind in _KINDS:
            return [kind.__name__, *_KINDS[kind][0](value, pack)]
        for place, file in enumerate(files):
            if value is file:
                return ["file", place]
        if isinstance(value, Path):
            return ["path", str(value)]
        if isinstance(value, np.generic):
            return ["scalar", _array_text(np.asarray(value))]
        name = f"{kind.__module__}:{kind.__qualname__}"
        if not _is_record(kind):
            raise TypeError(f"a value of the type {name} is no answer")
        if isinstance(value, enum.Enum):
            return ["enum", name, value.name]
        items = value if isinstance(value, tuple) else [getattr(value, field.name) for field in _fields(kind)]
        return ["record", name, *map(pack, items)]

    import msgspec  # only readers of files need it

    return msgspec.msgpack.encode(pack(value))


def decode(text: bytes | bytearray, files: Sequence[Any] = ()) -> Any:
    """Return the value of a text; see `encode`.

    Raises:
        AnswerError: the text is damaged or names something else than values.
    """

    def unpack(value: Any) -> Any:
        if not isinstance(value, list):
            return value
        kind, *items = value
        if kind == "file":
            return files[items[0]]
        if kind == "path":
            return Path(items[0])
        if kind == "scalar":
            return _array_of_text(items[0])[()]
        if kind == "enum":
            return _record_type(items[0], enum.Enum)[items[1]]
        if kind == "record":
            return _record(_record_type(items[0]), list(map(unpack, items[1:])))
        return _BY_NAME[kind](items, unpack)

    import msgspec

    try:
        return unpack(msgspec.msgpack.decode(text))
    except Exception as error:  # whatever a hostile answer makes fail
        raise AnswerError(f"no proper answer: {error}") from error


def write_answer(file: IO[bytes], text: bytes) -> None:
    """Write the text of an answer to a file, with its length before it."""
    file.write(len(text).to_bytes(_LENGTH_BYTES, "little"))
    file.write(text)
    file.flush()


def read_answer(file: IO[bytes], limit: int) -> Any:
    """Return the next answer in a file.

    Args:
        file: what the process writes.
        limit: largest size of the answer [bytes].

    Raises:
        EOFError: the process has ended before the end of its answer.
        AnswerError: the answer is larger, damaged, or names something else than values.
    """
    length = int.from_bytes(_exactly(file, _LENGTH_BYTES), "little")
    if length > limit:
        raise AnswerError("the answer is too large")
    return decode(_exactly(file, length))


def _exactly(file: IO[bytes], size: int) -> bytes:
    content = file.read(size)
    if len(content) < size:
        raise EOFError
    return content


_fields = functools.cache(dataclasses.fields)


def _record(kind: Any, values: list[Any]) -> Any:
    """Return a record of a type, made by its constructor; the fields that this does not take are set afterwards."""
    if issubclass(kind, tuple):
        return kind(*values)
    pairs = list(zip(_fields(kind), values, strict=True))
    record = kind(**{field.name: value for field, value in pairs if field.init})
    for field, value in pairs:
        if not field.init:
            object.__setattr__(record, field.name, value)
    return record


def _is_record(kind: Any) -> bool:
    return (
        isinstance(kind, type)
        and kind.__module__.split(".")[0] in _PACKAGES
        and (dataclasses.is_dataclass(kind) or issubclass(kind, (enum.Enum, tuple)))
    )


@functools.lru_cache(maxsize=1000)
def _record_type(name: str, base: type = object) -> Any:
    """Return our type with the name "module:Class"."""
    module, _, path = name.partition(":")
    if module.split(".")[0] not in _PACKAGES or "__" in name:
        raise AnswerError(f"{name} is not ours")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not (_is_record(found) and issubclass(found, base)):
        raise AnswerError(f"{name} is no record")
    return found


def _array_text(values: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, values, allow_pickle=False)
    return buffer.getvalue()


def _array_of_text(text: bytes) -> np.ndarray:
    return np.load(io.BytesIO(text), allow_pickle=False)


def _pack_array(values: np.ndarray, pack: _Pack) -> list[Any]:
    """Return the items of an array; one of objects has a shape before them."""
    return [_array_text(values)] if values.dtype != object else [list(values.shape), *map(pack, values.ravel())]


def _unpack_array(items: list[Any], unpack: _Pack) -> np.ndarray:
    if isinstance(items[0], bytes):
        return _array_of_text(items[0])
    values = np.empty(len(items) - 1, dtype=object)
    values[:] = list(map(unpack, items[1:]))
    return values.reshape(items[0])


def _pack_items(values: Any, pack: _Pack) -> list[Any]:
    return list(map(pack, values))


def _pack_mapping(values: dict[Any, Any], pack: _Pack) -> list[Any]:
    return [pack(item) for entry in values.items() for item in entry]


def _unpack_mapping(items: list[Any], unpack: _Pack) -> dict[Any, Any]:
    values = iter(map(unpack, items))
    return dict(zip(values, values, strict=True))


_KINDS: dict[type, tuple[Callable[[Any, _Pack], list[Any]], Callable[[list[Any], _Pack], Any]]] = {
    kind: (_pack_items, lambda items, unpack, kind=kind: kind(map(unpack, items)))
    for kind in (list, tuple, set, frozenset)
} | {
    dict: (_pack_mapping, _unpack_mapping),
    Counter: (_pack_mapping, lambda items, unpack: Counter(_unpack_mapping(items, unpack))),
    int: (lambda value, _: [str(value)], lambda items, _: int(items[0])),
    complex: (lambda value, _: [value.real, value.imag], lambda items, _: complex(*items)),
    range: (lambda value, _: [value.start, value.stop, value.step], lambda items, _: range(*items)),
    bytearray: (lambda value, _: [bytes(value)], lambda items, _: bytearray(items[0])),
    array.array: (
        lambda value, _: [value.typecode, value.tobytes()],
        lambda items, _: array.array(items[0], items[1]),
    ),
    np.ndarray: (_pack_array, _unpack_array),
}
"""How a value of each type becomes items of plain values, and is made of them again."""
_BY_NAME = {kind.__name__: unpack for kind, (_, unpack) in _KINDS.items()}
