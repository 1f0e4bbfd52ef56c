"""The answers of a process that reads files: plain values, NumPy's arrays, and our own records of them.

A file may have taken over the process, and a pickle may name any function to call. Here it names types only: those of
values, and our dataclasses, enumerations and named tuples, which do nothing but hold what they are given.
"""

from __future__ import annotations

import dataclasses
import enum
import pickle
from typing import IO, Any

_PACKAGES = ("aero_planner", "aero_viz")
_VALUES = {
    "array": {"_array_reconstructor", "array"},
    "builtins": {"bytearray", "complex", "frozenset", "range", "set", "slice"},
    "collections": {"Counter", "OrderedDict", "defaultdict", "deque"},
    "pathlib": {"Path", "PosixPath", "PurePosixPath", "PureWindowsPath", "WindowsPath"},
    "numpy": {"dtype", "ndarray"},
    **{
        f"numpy.{core}.{module}": names
        for core in ("core", "_core")
        for module, names in (("multiarray", {"_reconstruct", "scalar"}), ("numeric", {"_frombuffer"}))
    },
}
"""Types, and the functions that make arrays, by module."""


class Unpickler(pickle.Unpickler):
    """Makes values and records only; raises UnpicklingError for anything else."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a type that an answer may name."""
        if name in _VALUES.get(module, ()):
            return super().find_class(module, name)
        if module.split(".")[0] in _PACKAGES:
            found = super().find_class(module, name)
            if isinstance(found, type) and (dataclasses.is_dataclass(found) or issubclass(found, (enum.Enum, tuple))):
                return found
        raise pickle.UnpicklingError(f"an answer names {module}.{name}, which is no value")


def encode(value: Any) -> bytes:
    """Return the text of an answer."""
    return pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)


def decode(file: IO[bytes], limit: int) -> Any:
    """Return the next answer in a file.

    Args:
        file: what the process writes.
        limit: largest size of the answer [bytes].

    Raises:
        EOFError: the process has ended before the end of its answer.
        pickle.UnpicklingError: the answer is larger, damaged, or names something else than values. So does anything
            else that an answer makes fail.
    """
    bounded = _Bounded(file, limit)
    try:
        return Unpickler(bounded).load()
    except EOFError:
        raise
    except Exception as error:
        if bounded.has_ended:
            raise EOFError from error
        raise pickle.UnpicklingError(f"no proper answer: {error}") from error


class _Bounded:
    """The first bytes of a file; reading more fails."""

    def __init__(self, file: IO[bytes], limit: int) -> None:
        self.has_ended = False
        self._file, self._left = file, limit

    def read(self, size: int) -> bytes:
        """Return the next bytes."""
        return self._counted(self._file.read(min(size, self._left + 1)), size)

    def readline(self) -> bytes:
        """Return the next bytes up to the end of a line."""
        return self._counted(self._file.readline(self._left + 1), 1)

    def _counted(self, data: bytes, wanted: int) -> bytes:
        self._left -= len(data)
        if self._left < 0:
            raise pickle.UnpicklingError("it is too large")
        self.has_ended = len(data) < wanted
        return data
