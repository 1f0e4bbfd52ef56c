"""All kinds of input, and the case of each number."""

import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from fuzz import messages, telemetry
from fuzz.mutation import mutate
from fuzz.ports import PORTS
from fuzz.seeds import SEEDS, mutable_files

_GENERATED: dict[str, tuple[str, Callable[[np.random.Generator], bytes], int]] = {
    **{name: ("port", port.generate, port.inputs) for name, port in PORTS.items()},
    "node.telemetry": ("node", telemetry.generate, 1),
    "control.messages": ("page", messages.generate, messages.COUNT),
    "visitor.messages": ("page", messages.generate, messages.COUNT),
}
"""Input that is not made from a whole file: the target, what returns a case, and the number of inputs in it."""

NAMES = (*SEEDS, *_GENERATED)
"""Names of the kinds of input, which are those of their files."""
TARGET = {name: kind[0] for name, kind in (*SEEDS.items(), *_GENERATED.items())}
"""Function of `fuzz.targets` that reads them."""
INPUTS = {name: _GENERATED[name][2] if name in _GENERATED else 1 for name in NAMES}
"""Number of datagrams, messages or files in a case."""


def write_seed(name: str, folder: Path) -> Path | None:
    """Write the whole file of a kind into a folder, and return the path to open; None for generated input."""
    if name in _GENERATED:
        return None
    SEEDS[name][1](folder / name)
    return mutable_files(folder / name)[0]


def write_case(name: str, seeds: Path, folder: Path, number: int) -> Path:
    """Write case `number` of a kind into a folder, and return the path to open. `seeds` is that of `write_seed`."""
    random = np.random.default_rng([zlib.crc32(name.encode()), number])
    copy, seed = folder / name, seeds / name
    if name in _GENERATED:
        copy.write_bytes(_GENERATED[name][1](random))
        return copy
    target, files = mutable_files(seed)
    victim = files[int(random.integers(len(files)))]
    shutil.rmtree(copy, ignore_errors=True)
    if seed.is_dir():
        shutil.copytree(seed, copy)
    place = copy / victim.relative_to(seed) if seed.is_dir() else copy
    place.write_bytes(mutate(victim.read_bytes(), random))
    return copy / target.relative_to(seed) if seed.is_dir() else copy
