"""Bundles: what a drone needs to plan without a compiler, in one folder or tar file.

    manifest.json     what it is for, and size and SHA-256 of every other file
    config.yaml       the configuration, as it was given
    kernels/..        compiled kernels, as Warp's cache lays them out
    graph/cpu, sm_..  the plan as a sequence of launches for the C++ host, where the exporting machine could capture it

`open_bundle` trusts none of it: whatever does not fit is refused with the reason, and what fits is copied to a folder
of its own, so that neither the bundle nor what is loaded from it can change afterwards.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import stat
import tarfile
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import warp as wp

from aero_planner.config import PlannerConfig, parameters
from aero_planner.planner import _find_device

__all__ = [
    "CONFIG",
    "FORMAT",
    "GRAPH",
    "KERNELS",
    "MANIFEST",
    "Bundle",
    "cpu_target",
    "open_bundle",
    "planner_digest",
    "structure_of",
]

FORMAT = 1
MANIFEST, CONFIG, KERNELS, GRAPH = "manifest.json", "config.yaml", "kernels", "graph"

_MOST_FILES = 4096
_MOST_BYTES = 512 * 2**20
_MOST_MANIFEST = 4 * 2**20
_PIECE = 2**20
_BLOCK = tarfile.BLOCKSIZE

_NAME = re.compile(r"(?!\.\.?(/|$))[\w.+-]+(/(?!\.\.?(/|$))[\w.+-]+){0,5}", re.ASCII)
_ANEW = "export it again with 'aero-planner export'"


@dataclass(eq=False)
class Bundle:
    """A bundle whose files are what its manifest says; `fit` says whether they are of use here."""

    source: str
    """Where it came from, as named in errors."""
    folder: Path
    """Private copy of configuration and kernels; gone after `close`."""
    warp: str
    planner: str
    """See `planner_digest`."""
    architectures: tuple[int, ...]
    """Compute capabilities without the dot."""
    cpu: str | None
    """See `cpu_target`; None where there are no kernels for a CPU."""
    structure: dict[str, Any]
    """Values of the structural parameters, by path."""
    created: str
    files: frozenset[str] = field(repr=False)
    _cache: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._end = weakref.finalize(self, shutil.rmtree, self.folder, True)

    @property
    def config_file(self) -> Path:
        """The configuration that it was exported with."""
        return self.folder / CONFIG

    def describe(self) -> str:
        """Return what it is for, in a few words."""
        targets = [f"sm_{one}" for one in self.architectures] + (["CPU"] if self.cpu else [])
        return f"kernels for {', '.join(targets)}, Warp {self.warp}, exported {self.created}"

    def fit(self, config: PlannerConfig, device: str) -> None:
        """Make Warp load kernels from here instead of its cache; call it before the first planner of the process.

        Raises:
            ValueError: the kernels are for another Warp, planner, structure of the configuration, or processor.
        """
        here = _find_device(device)
        for what, its, ours in (
            ("Warp", self.warp, wp.config.version), ("state of aero-planner", self.planner, planner_digest()),
        ):  # fmt: skip
            if its != ours:
                raise ValueError(
                    f"the bundle {self.source} is for another {what} ({its[:12]}; here is {ours[:12]}): {_ANEW} with "
                    "the versions of this machine."
                )
        wanted = structure_of(config)
        for path in sorted(wanted.keys() | self.structure.keys()):
            if wanted.get(path) != self.structure.get(path):
                raise ValueError(
                    f"the bundle {self.source} is for {path} = {self.structure.get(path)!r}, the configuration says "
                    f"{wanted.get(path)!r}: {_ANEW} with this configuration."
                )
        self._check_processor(here.arch if here.is_cuda else None)
        self._cache = self._cache or wp.config.kernel_cache_dir
        wp.config.kernel_cache_dir = str(self.folder / KERNELS)

    def _check_processor(self, architecture: int | None) -> None:
        """Raise ValueError where there are no kernels for a GPU of `architecture`, or None: for this CPU."""
        if architecture is None and self.cpu != cpu_target():
            found = f"another CPU ({self.cpu}; here is {cpu_target()})" if self.cpu else "GPUs only"
            raise ValueError(f"the bundle {self.source} has kernels for {found}: {_ANEW} --cpu on this machine.")
        if architecture is not None and architecture not in self.architectures:
            found = ", ".join(f"sm_{one}" for one in self.architectures) or "a CPU only"
            raise ValueError(
                f"the bundle {self.source} has kernels for {found}, the device is an sm_{architecture}: {_ANEW} "
                f"--arch sm_{architecture}."
            )

    def compiled(self) -> list[str]:
        """Return what the compiler has added since; empty when the bundle had every kernel that was needed."""
        found = (path for path in self.folder.rglob("*") if path.is_file())
        return sorted({path.relative_to(self.folder).as_posix() for path in found} - self.files)

    def close(self) -> None:
        """Remove the copy, and let Warp use its own cache again."""
        if self._cache is not None:
            wp.config.kernel_cache_dir, self._cache = self._cache, None
        self._end()

    def __enter__(self) -> Bundle:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_bundle(path: str | os.PathLike[str]) -> Bundle:
    """Check a bundle, a folder or a tar file, and copy what a planner needs of it.

    Raises:
        ValueError: it can't be read, is no bundle, of another format, damaged or incomplete, or larger than any bundle
            (4096 files, 512 MiB).
    """
    source = Path(path)
    copy = Path(tempfile.mkdtemp(prefix="aero-planner-"))
    try:
        if source.is_dir():
            return _check(source, copy, str(path))
        if source.exists() and not source.is_file():
            raise ValueError("is neither a folder nor a whole tar file")
        unpacked = copy / "unpacked"
        with source.open("rb") as file:
            _unpack(file, unpacked)
        bundle = _check(unpacked, copy, str(path))
        shutil.rmtree(unpacked)
        return bundle
    except OSError as error:
        shutil.rmtree(copy, True)
        raise ValueError(f"the bundle {path} can't be read: {error.strerror or error}.") from error
    except ValueError as error:
        shutil.rmtree(copy, True)
        raise ValueError(f"the bundle {path} {error}: {_ANEW}, or copy it anew.") from error
    except BaseException:
        shutil.rmtree(copy, True)
        raise


@functools.cache
def planner_digest() -> str:
    """Return a digest of everything in this package that kernels are made of."""
    digest = hashlib.sha256("\n".join(info.path for info in parameters()).encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        content = path.read_bytes()
        if re.search(rb"^\s*@wp\.|wp\.struct\(", content, re.MULTILINE):
            digest.update(content)
    return digest.hexdigest()


def structure_of(config: PlannerConfig) -> dict[str, Any]:
    """Return the structural parameters by path: buffers, graph and kernels depend on them."""
    return {info.path: config.get(info.path) for info in parameters() if not info.live}


def cpu_target() -> str:
    """Return what names this machine's CPU, its features included, to the kernels compiled for it."""
    _find_device("cpu")
    key = getattr(wp, "get_cpu_kernel_cache_key", None)
    if key is not None:
        return str(key())
    # Warps before 1.19 name no CPU, and compile for the features of the one that they run on.
    features = b""
    with contextlib.suppress(OSError):
        features = b"".join(re.findall(rb"(?m)^(?:flags|Features)\s*:.*$", Path("/proc/cpuinfo").read_bytes())[:1])
    digest = hashlib.sha256(features).hexdigest()[:8]
    return f"{wp.config.version}-{platform.system()}-{platform.machine()}-{digest}"


def _unpack(file: IO[bytes], folder: Path) -> None:
    """Write the files of an uncompressed tar file below `folder`, block by block.

    Only plain files under plain names get through; links, devices, and extensions for what plain names can't say do
    not, so that nothing in it is taken for a place to write to or an amount of memory to allocate.
    """
    count = total = 0
    while True:
        header = file.read(_BLOCK)
        if count and (len(header) == _BLOCK and not any(header)):
            return
        try:
            entry = tarfile.TarInfo.frombuf(header, "ascii", "strict")
        except (tarfile.HeaderError, ValueError, OverflowError) as error:
            what = "is truncated" if count and len(header) < _BLOCK else "is neither a folder nor a whole tar file"
            raise ValueError(what) from error
        count += 1
        name = entry.name.removeprefix("./").rstrip("/")
        if entry.type == tarfile.DIRTYPE:
            if name not in ("", ".") and not _NAME.fullmatch(name):
                raise ValueError(f"holds the name {entry.name[:80]!r}, which leads elsewhere or means nothing")
            continue
        if entry.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise ValueError(f"holds {entry.name[:80]!r}, which is a link or something else that is no file")
        if not _NAME.fullmatch(name):
            raise ValueError(f"holds the name {entry.name[:80]!r}, which leads elsewhere or means nothing")
        total += max(entry.size, 0)
        if entry.size < 0 or total > _MOST_BYTES or count > _MOST_FILES:
            raise ValueError("is larger than any bundle")
        target = folder / name
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("xb") as output:
                for piece in _pieces(file, entry.size):
                    output.write(piece)
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            raise ValueError(f"holds {name!r} twice") from error
        file.read(-entry.size % _BLOCK)


def _pieces(file: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield the next `size` bytes of a file in pieces; ValueError where it ends before."""
    while size > 0:
        piece = file.read(min(size, _PIECE))
        if not piece:
            raise ValueError("is truncated")
        size -= len(piece)
        yield piece


def _check(folder: Path, copy: Path, source: str) -> Bundle:
    """Compare a folder with its manifest; what a planner needs of it is copied on the way."""
    manifest = _manifest(folder)
    files: dict[str, Any] = _field(manifest, "files", dict)
    if CONFIG not in files:
        raise ValueError(f"has no {CONFIG}")
    if len(files) > _MOST_FILES:
        raise ValueError("is larger than any bundle")
    copied, total = set[str](), 0
    for name, said in files.items():
        size, digest = (said.get("size"), said.get("sha256")) if isinstance(said, dict) else (None, None)
        if not _NAME.fullmatch(name) or name == MANIFEST:
            raise ValueError(f"holds the name {name[:80]!r}, which leads elsewhere or means nothing")
        if type(size) is not int or size < 0 or not isinstance(digest, str):
            raise ValueError(f"has a manifest that does not say size and sha256 of {name}")
        total += size
        if total > _MOST_BYTES:
            raise ValueError("is larger than any bundle")
        target = None
        if name == CONFIG or name.startswith(f"{KERNELS}/"):
            target = copy / name
            copied.add(name)
        if _digest(folder, name, size, target) != digest:
            raise ValueError(f"is damaged: {name} has another checksum than its manifest says")
    architectures = _field(manifest, "architectures", list)
    if not all(type(one) is int for one in architectures):
        raise ValueError("has a manifest with other than whole numbers in 'architectures'")
    cpu = manifest.get("cpu")
    return Bundle(
        source=source, folder=copy, warp=_field(manifest, "warp", str), planner=_field(manifest, "planner", str),
        architectures=tuple(architectures), cpu=cpu if isinstance(cpu, str) else None,
        structure=_field(manifest, "structure", dict), created=_field(manifest, "created", str),
        files=frozenset(copied),
    )  # fmt: skip


def _manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    if not path.is_file() or path.is_symlink():
        raise ValueError(f"has no {MANIFEST}")
    with path.open("rb") as file:
        content = file.read(_MOST_MANIFEST + 1)
    try:
        manifest = json.loads(content) if len(content) <= _MOST_MANIFEST else None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"has a {MANIFEST} that is no JSON") from error
    if not isinstance(manifest, dict) or "format" not in manifest:
        raise ValueError(f"has a {MANIFEST} that is none of a bundle")
    if manifest["format"] != FORMAT or type(manifest["format"]) is not int:
        raise ValueError(f"has format {str(manifest['format'])[:20]!r}; this aero-planner reads format {FORMAT}")
    return manifest


def _field(manifest: dict[str, Any], name: str, kind: type) -> Any:
    value = manifest.get(name)
    if type(value) is not kind:
        raise ValueError(f"has a manifest without a proper {name!r}")
    return value


def _digest(folder: Path, name: str, size: int, target: Path | None) -> str:
    """Return the SHA-256 of a file of exactly `size` bytes, and copy it where there is a target."""
    path = folder
    for part in name.split("/"):
        path = path / part
        if path.is_symlink():
            raise ValueError(f"holds {name!r}, which is a link or something else that is no file")
    try:
        found = path.stat()
    except OSError as error:
        raise ValueError(f"is incomplete: {name} is missing") from error
    if not stat.S_ISREG(found.st_mode):
        raise ValueError(f"holds {name!r}, which is a link or something else that is no file")
    if found.st_size != size:
        raise ValueError(f"is damaged: {name} has {found.st_size} bytes, its manifest says {size}")
    digest = hashlib.sha256()
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(path.open("rb"))
        output = None
        if target is not None:
            target.parent.mkdir(parents=True, exist_ok=True)
            output = stack.enter_context(target.open("wb"))
        for piece in _pieces(file, size):
            digest.update(piece)
            if output is not None:
                output.write(piece)
    return digest.hexdigest()
