"""Declaration of device arrays as dataclass fields, and the allocation that follows from it."""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import warp as wp
from numpy.typing import NDArray

Arrays = TypeVar("Arrays")
_ALIGNMENT = 256
_MOST_BUFFERS = 8


@dataclass(frozen=True)
class ArraySpec:
    """Declaration of a device array."""

    dtype: Any
    shape: str
    """Symbols (fields of the sizes), numbers, and sums and products of them, such as "B R N+1"."""
    unit: str
    text: str
    """Meaning, in one sentence."""
    kept: Literal["plans", "sweeps"] | None = None
    """What a later plan needs of the array: "plans" for state that is carried from plan to plan, "sweeps" for what is
    known from the sweeps in memory; None for nothing."""
    initial: float = 0.0
    """Value of all entries where nothing is known yet."""

    @property
    def item(self) -> np.dtype:
        """NumPy's type of an entry: a number, a vector or matrix, whose `base` is that of its numbers, or a struct."""
        if hasattr(self.dtype, "numpy_dtype"):
            return np.dtype(self.dtype.numpy_dtype())
        scalar = wp.dtype_to_numpy(getattr(self.dtype, "_wp_scalar_type_", self.dtype))
        return np.dtype((scalar, getattr(self.dtype, "_shape_", ())))

    def evaluate_shape(self, sizes: Any) -> tuple[int, ...]:
        """Return the shape for the sizes, an object with one attribute per symbol."""

        def product(text: str) -> int:
            return math.prod(int(factor) if factor.isdigit() else getattr(sizes, factor) for factor in text.split("*"))

        return tuple(sum(map(product, entry.split("+"))) for entry in self.shape.split())


def array(dtype: Any, shape: str, unit: str, text: str, **more: Any) -> Any:
    """Return a dataclass field that declares a device array; see `ArraySpec`."""
    return dataclasses.field(metadata={"array": ArraySpec(dtype, shape, unit, text, **more)})


class PackedArrays(Generic[Arrays]):
    """Arrays that share one allocation, so that one copy moves all of them between host and device.

    Args:
        kind: dataclass whose fields declare the arrays.
        sizes: an object with one attribute per symbol of their shapes.
        device: device of the arrays.
        more: further such dataclasses, whose arrays have other names.

    Attributes:
        arrays: an instance of `kind` with the device arrays.
        more: instances of the further dataclasses.
    """

    def __init__(self, kind: type[Arrays], sizes: Any, device: wp.Device, *, more: Sequence[type] = ()) -> None:
        kinds = (kind, *more)
        specs = {name: spec for group in kinds for name, spec in array_specs(group).items()}
        offsets: list[int] = []
        formats: list[Any] = []
        size = 0
        for spec in specs.values():
            size = -(-size // _ALIGNMENT) * _ALIGNMENT
            item = spec.item
            shape = spec.evaluate_shape(sizes)
            offsets.append(size)
            formats.append((item, shape))
            size += item.itemsize * math.prod(shape)
        # One record over the whole memory: its fields are the arrays.
        self._record = np.dtype({"names": list(specs), "formats": formats, "offsets": offsets, "itemsize": size})
        self._memory = wp.zeros(size, dtype=wp.uint8, device=device)
        pointer = int(self._memory.ptr or 0)
        views = {
            name: wp.array(ptr=pointer + offset, dtype=spec.dtype, shape=spec.evaluate_shape(sizes), device=device)
            for offset, (name, spec) in zip(offsets, specs.items(), strict=True)
        }
        self.arrays: Arrays = kind(**{name: views[name] for name in array_specs(kind)})
        self.more: list[Any] = [group(**{name: views[name] for name in array_specs(group)}) for group in more]
        # On the CPU the device's memory is the host's.
        self._host = self._memory if device.is_cpu else wp.zeros(size, dtype=wp.uint8, device="cpu", pinned=True)
        self._device = device
        self._downloaded = None if device.is_cpu else wp.Event(device)
        self._free_buffers: list[wp.array] = []
        self._buffer_count = 0
        self._target: NDArray[np.uint8] | None = None
        self._host_bytes: np.ndarray = self._host.numpy()
        record = self._as_record(self._host_bytes)
        self._host_arrays: dict[str, NDArray[Any]] = {name: record[name] for name in specs}

    def _as_record(self, memory: np.ndarray) -> np.ndarray:
        return memory.view(self._record).reshape(())

    def host(self) -> dict[str, NDArray[Any]]:
        """Return writable host views of the arrays by name; `upload` copies them to the device."""
        return self._host_arrays

    def upload(self) -> None:
        """Copy the host's values to the device, ordered before later launches."""
        if self._host is not self._memory:
            wp.copy(self._memory, self._host)

    def start_download(self) -> None:
        """Order the copy to the host, after the launches so far and before later ones."""
        if self._downloaded is not None:
            buffer, self._target = self._take_buffer()
            wp.copy(self._host if buffer is None else buffer, self._memory)
            self._device.stream.record_event(self._downloaded)

    def finish_download(self) -> np.ndarray:
        """Wait for the copy that `start_download` has ordered; return a record of arrays that nothing changes later."""
        if self._downloaded is not None:
            wp.synchronize_event(self._downloaded)
        else:
            _, self._target = self._take_buffer()
            if self._target is not None:
                self._target[:] = self._host_bytes
        target, self._target = self._target, None
        return self._as_record(self._host_bytes.copy() if target is None else target)

    def _take_buffer(self) -> tuple[wp.array | None, NDArray[np.uint8] | None]:
        """Return a staging buffer for one download, and a NumPy view of it; None if too much is in use.

        It is free again when that array and all views of it are gone.
        """
        if not self._free_buffers:
            if self._buffer_count == _MOST_BUFFERS:
                return None, None
            self._buffer_count += 1
            is_pinned = self._downloaded is not None
            self._free_buffers.append(wp.zeros(self._memory.size, dtype=wp.uint8, device="cpu", pinned=is_pinned))
        buffer = self._free_buffers.pop()
        values: Any = buffer.numpy()
        weakref.finalize(values, self._free_buffers.append, buffer).atexit = False
        return buffer, values


def array_specs(kind: type) -> dict[str, ArraySpec]:
    """Return the declarations of the arrays of a dataclass, by name."""
    return {field.name: field.metadata["array"] for field in dataclasses.fields(kind)}


def as_dict(arrays: Any) -> dict[str, wp.array]:
    """Return the arrays of a dataclass of arrays, by name."""
    return {name: getattr(arrays, name) for name in array_specs(type(arrays))}


def allocate(kind: type[Arrays], sizes: Any, device: wp.Device, **present: wp.array) -> Arrays:
    """Return an instance of a dataclass with the arrays `present` and the others all zero, each with its own memory."""
    zeros = {
        name: wp.zeros(spec.evaluate_shape(sizes), dtype=spec.dtype, device=device)
        for name, spec in array_specs(kind).items()
        if name not in present
    }
    return kind(**zeros, **present)


def forget(arrays: Any, kept: str) -> None:
    """Set the arrays of a dataclass that are kept for `kept` to their initial values."""
    for name, spec in array_specs(type(arrays)).items():
        if spec.kept == kept:
            getattr(arrays, name).fill_(_filled(spec))


def _filled(spec: ArraySpec) -> Any:
    if hasattr(spec.dtype, "_shape_"):
        return spec.dtype(spec.initial)
    return int(spec.initial) if spec.dtype is wp.int32 else spec.initial


def as_vectors(values: wp.array, width: int) -> wp.array:
    """Return a view of a contiguous float array whose last axis is split into vectors of `width`."""
    shape = (*values.shape[:-1], values.shape[-1] // width)
    dtype = wp.types.vector(length=width, dtype=wp.float32)
    return wp.array(ptr=values.ptr, dtype=dtype, shape=shape, device=values.device)


def as_scalars(vectors: wp.array) -> wp.array:
    """Return a view of a contiguous array of vectors as floats; the vectors' axis is merged into the last one."""
    shape = (*vectors.shape[:-1], vectors.shape[-1] * vectors.dtype._length_)
    return wp.array(ptr=vectors.ptr, dtype=wp.float32, shape=shape, device=vectors.device)
