"""Bundles: a folder or tar file with everything that a drone needs to plan without a compiler.

    manifest.json     versions and processors that the bundle is for, and size and SHA-256 of every other file
    config.yaml       the configuration, unchanged
    kernels/..        compiled kernels in the layout of Warp's cache
    graph/cpu, sm_..  the plan as a sequence of launches for the C++ host, if the exporting machine could capture it

`open_bundle` trusts nothing in a bundle. It refuses a bundle that does not fit, with the reason, and copies the files
that a planner needs to a private folder, so that later changes of the bundle have no effect.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import re
import shutil
import stat
import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import warp as wp

from aero_planner import registry
from aero_planner.config import PlannerConfig
from aero_planner.user_file import open_user_file, parse_json
from aero_planner.warp_init import find_device

FORMAT = 1
MANIFEST, CONFIG, KERNELS, GRAPH = "manifest.json", "config.yaml", "kernels", "graph"

_MAX_FILES = 4096
_MAX_BYTES = 512 * 2**20
_MAX_MANIFEST_BYTES = 4 * 2**20
_MAX_NAME_BYTES = 1024
_CHUNK = 2**20
_BLOCK = tarfile.BLOCKSIZE

_PACKAGES = ("costs", "device", "kernels", "models", "stages")
"""Packages whose sources make kernels."""
_KINDS: tuple[registry.Kind, ...] = ("stages", "cost_terms", "models")

_NAME = re.compile(r"(?!\.\.?(/|$))[\w.+-]+(/(?!\.\.?(/|$))[\w.+-]+){0,5}", re.ASCII)
_EXPORT_AGAIN = "export it again with 'aero-planner export'"


@dataclass(eq=False)
class Bundle:
    """A bundle whose files match its manifest. `activate` checks that it suits this machine and configuration."""

    source: str
    """Path of the bundle, as named in errors."""
    _copy: tempfile.TemporaryDirectory[str] = field(repr=False)
    """Folder with configuration and kernels, which `close` removes."""
    warp: str
    """Version of Warp."""
    planner: str
    """Digest of the planner's sources, see `planner_digest`."""
    architectures: tuple[int, ...]
    """GPU compute capabilities without the dot."""
    cpu: str | None
    """Name of the CPU, see `cpu_target`; None if there are no kernels for a CPU."""
    structure: dict[str, Any]
    """Values of the structural parameters by path."""
    created: str
    """Date of the export."""
    files: frozenset[str] = field(repr=False)
    _cache: str | None = field(default=None, repr=False)

    @property
    def folder(self) -> Path:
        """Private copy of configuration and kernels."""
        return Path(self._copy.name)

    @property
    def config_file(self) -> Path:
        """File with the configuration that the bundle was exported with."""
        return self.folder / CONFIG

    def describe(self) -> str:
        """Return the processors, the version of Warp and the date of the export in a few words."""
        targets = [f"sm_{number}" for number in self.architectures] + (["CPU"] if self.cpu else [])
        return f"kernels for {', '.join(targets)}, Warp {self.warp}, exported {self.created}"

    def activate(self, config: PlannerConfig, device: str) -> None:
        """Make Warp load kernels from this bundle instead of its cache; call it before creating the first planner.

        Raises:
            ValueError: the kernels are for another Warp, planner, structure of the configuration, or processor.
        """
        target = find_device(device)
        for name, exported, local in (
            ("Warp", self.warp, wp.config.version), ("state of aero-planner", self.planner, planner_digest()),
        ):  # fmt: skip
            if exported != local:
                raise ValueError(
                    f"the bundle {self.source} is for another {name} ({exported[:12]}; here is {local[:12]}): "
                    f"{_EXPORT_AGAIN} with the versions of this machine."
                )
        structure = dict(config.structure())  # buffers, graph and kernels depend on it
        for path in sorted(structure.keys() | self.structure.keys()):
            if structure.get(path) != self.structure.get(path):
                raise ValueError(
                    f"the bundle {self.source} is for {path} = {self.structure.get(path)!r}, the configuration says "
                    f"{structure.get(path)!r}: {_EXPORT_AGAIN} with this configuration."
                )
        self.check_processor(target.arch if target.is_cuda else None)
        self._cache = self._cache or wp.config.kernel_cache_dir
        wp.config.kernel_cache_dir = str(self.folder / KERNELS)

    def check_processor(self, architecture: int | None) -> None:
        """Raise ValueError if there are no kernels for a GPU of `architecture`, or for this CPU if it is None."""
        if architecture is None and self.cpu != cpu_target():
            targets = f"another CPU ({self.cpu}; here is {cpu_target()})" if self.cpu else "GPUs only"
            raise ValueError(
                f"the bundle {self.source} has kernels for {targets}: {_EXPORT_AGAIN} --cpu on this machine."
            )
        if architecture is not None and architecture not in self.architectures:
            targets = ", ".join(f"sm_{number}" for number in self.architectures) or "a CPU only"
            raise ValueError(
                f"the bundle {self.source} has kernels for {targets}, the device is an sm_{architecture}: "
                f"{_EXPORT_AGAIN} --arch sm_{architecture}."
            )

    def compiled(self) -> list[str]:
        """Return the files that Warp has compiled since `activate`; empty if the bundle had every kernel."""
        present = (path for path in self.folder.rglob("*") if path.is_file())
        return sorted({path.relative_to(self.folder).as_posix() for path in present} - self.files)

    def close(self) -> None:
        """Remove the private copy, and make Warp use its own cache again."""
        if self._cache is not None:
            wp.config.kernel_cache_dir, self._cache = self._cache, None
        self._copy.cleanup()

    def __enter__(self) -> Bundle:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_bundle(path: str | os.PathLike[str]) -> Bundle:
    """Check a bundle, a folder or a tar file, and copy the files that a planner needs.

    Raises:
        ValueError: the bundle can't be read, has another format, is damaged or incomplete, or is too large (more than
            4096 files or 512 MiB).
    """
    source = Path(path)
    copy = tempfile.TemporaryDirectory(prefix="aero-planner-", ignore_cleanup_errors=True)
    try:
        if source.is_dir():
            return _check(source, copy, str(path))
        if source.exists() and not source.is_file():
            raise ValueError("is neither a folder nor a whole tar file")
        unpacked = Path(copy.name) / "unpacked"
        with open_user_file(source) as file:
            _unpack(file, unpacked)
        bundle = _check(unpacked, copy, str(path))
        shutil.rmtree(unpacked)
        return bundle
    except OSError as error:
        copy.cleanup()
        raise ValueError(f"the bundle {path} can't be read: {error.strerror or error}.") from error
    except ValueError as error:
        copy.cleanup()
        raise ValueError(f"the bundle {path} {error}: {_EXPORT_AGAIN}, or copy it again.") from error
    except BaseException:
        copy.cleanup()
        raise


@functools.cache
def planner_digest() -> str:
    """Return a digest of the names of all parameters, cost terms and models, and of the sources that make kernels."""
    names = [info.path for info in PlannerConfig.parameters()]
    names += [name for kind in _KINDS for name in registry.names(kind)]
    digest = hashlib.sha256("\n".join(names).encode())
    root = Path(__file__).parents[1]
    packages = (path for package in _PACKAGES for path in sorted((root / package).rglob("*.py")))
    for path in (root / "composition.py", *packages):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def cpu_target() -> str:
    """Return the name of this machine's CPU and its features, as far as compiled kernels depend on them."""
    find_device("cpu")
    key = getattr(wp, "get_cpu_kernel_cache_key", None)
    if key is not None:
        return str(key())
    # Versions of Warp before 1.19 do not name the CPU, and compile for the features of the one that they run on.
    features = b""
    with contextlib.suppress(OSError):
        features = b"".join(re.findall(rb"(?m)^(?:flags|Features)\s*:.*$", Path("/proc/cpuinfo").read_bytes())[:1])
    digest = hashlib.sha256(features).hexdigest()[:8]
    return f"{wp.config.version}-{platform.system()}-{platform.machine()}-{digest}"


def _unpack(file: IO[bytes], folder: Path) -> None:
    """Write the files of an uncompressed tar file to `folder`, block by block.

    Only plain files with plain names are accepted. Links, devices and extension headers, except for GNU tar's names of
    more than 100 characters, are refused, so that no entry decides where a file is written or how much memory is
    allocated. `tarfile.data_filter` is less strict: it accepts links and absolute names, and extension headers of any
    size are read before it is called.
    """
    count = total = 0
    long_name: str | None = None  # of the next entry
    while True:
        header = file.read(_BLOCK)
        if count and (len(header) == _BLOCK and not any(header)):
            return
        try:
            entry = tarfile.TarInfo.frombuf(header, "ascii", "strict")
        except (tarfile.HeaderError, ValueError, OverflowError) as error:
            is_cut = count and len(header) < _BLOCK
            raise ValueError("is truncated" if is_cut else "is neither a folder nor a whole tar file") from error
        if entry.type == tarfile.GNUTYPE_LONGNAME:
            long_name = _read_long_name(file, entry.size)
            continue
        count += 1
        full_name, long_name = long_name or entry.name, None
        name = full_name.removeprefix("./").rstrip("/")
        if entry.type == tarfile.DIRTYPE:
            if name not in ("", ".") and not _NAME.fullmatch(name):
                raise ValueError(f"holds the name {full_name[:80]!r}, which is not a plain relative path")
            continue
        if entry.type in (tarfile.XHDTYPE, tarfile.XGLTYPE):
            raise ValueError("is a tar file in pax format, which is not read; pack the folder with tar --format=gnu")
        if entry.type not in (tarfile.REGTYPE, tarfile.AREGTYPE):
            raise ValueError(f"holds {full_name[:80]!r}, which is a link or another special file")
        if not _NAME.fullmatch(name):
            raise ValueError(f"holds the name {full_name[:80]!r}, which is not a plain relative path")
        total += max(entry.size, 0)
        if entry.size < 0 or total > _MAX_BYTES or count > _MAX_FILES:
            raise ValueError("is larger than any bundle")
        target = folder / name
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("xb") as output:
                for chunk in _chunks(file, entry.size):
                    output.write(chunk)
        except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
            raise ValueError(f"holds {name!r} twice") from error
        file.read(-entry.size % _BLOCK)


def _read_long_name(file: IO[bytes], size: int) -> str:
    """Return the content of an entry of type "L" with which GNU tar precedes an entry with a long name."""
    if not 0 < size <= _MAX_NAME_BYTES:
        raise ValueError(f"holds a name of {size} bytes, which is not a plain relative path")
    content = b"".join(_chunks(file, size))
    file.read(-size % _BLOCK)
    return content.rstrip(b"\0").decode("ascii", "replace")


def _chunks(file: IO[bytes], size: int) -> Iterator[bytes]:
    """Yield the next `size` bytes of a file in chunks; raises ValueError if the file is shorter."""
    while size > 0:
        chunk = file.read(min(size, _CHUNK))
        if not chunk:
            raise ValueError("is truncated")
        size -= len(chunk)
        yield chunk


def _check(folder: Path, copy: tempfile.TemporaryDirectory[str], source: str) -> Bundle:
    """Compare a folder with its manifest, and copy the files that a planner needs to `copy`."""
    manifest = _read_manifest(folder)
    files: dict[str, Any] = _field(manifest, "files", dict)
    if CONFIG not in files:
        raise ValueError(f"has no {CONFIG}")
    if len(files) > _MAX_FILES:
        raise ValueError("is larger than any bundle")
    copied, total = set[str](), 0
    for name, entry in files.items():
        size, digest = (entry.get("size"), entry.get("sha256")) if isinstance(entry, dict) else (None, None)
        if not _NAME.fullmatch(name) or name == MANIFEST:
            raise ValueError(f"holds the name {name[:80]!r}, which is not a plain relative path")
        if type(size) is not int or size < 0 or not isinstance(digest, str):
            raise ValueError(f"has a manifest that does not say size and sha256 of {name}")
        total += size
        if total > _MAX_BYTES:
            raise ValueError("is larger than any bundle")
        target = None
        if name == CONFIG or name.startswith(f"{KERNELS}/"):
            target = Path(copy.name) / name
            copied.add(name)
        if _digest(folder, name, size, target) != digest:
            raise ValueError(f"is damaged: {name} has another checksum than its manifest says")
    architectures = _field(manifest, "architectures", list)
    if not all(type(number) is int for number in architectures):
        raise ValueError("has a manifest with other than whole numbers in 'architectures'")
    cpu = manifest.get("cpu")
    return Bundle(
        source=source, _copy=copy, warp=_field(manifest, "warp", str), planner=_field(manifest, "planner", str),
        architectures=tuple(architectures), cpu=cpu if isinstance(cpu, str) else None,
        structure=_field(manifest, "structure", dict), created=_field(manifest, "created", str),
        files=frozenset(copied),
    )  # fmt: skip


def _read_manifest(folder: Path) -> dict[str, Any]:
    path = folder / MANIFEST
    if not path.is_file() or path.is_symlink():
        raise ValueError(f"has no {MANIFEST}")
    with open_user_file(path) as file:
        content = file.read(_MAX_MANIFEST_BYTES + 1)
    try:
        manifest = parse_json(content) if len(content) <= _MAX_MANIFEST_BYTES else None
    except ValueError as error:
        raise ValueError(f"has a {MANIFEST} that is not JSON") from error
    if not isinstance(manifest, dict) or "format" not in manifest:
        raise ValueError(f"has a {MANIFEST} that does not describe a bundle")
    if manifest["format"] != FORMAT or type(manifest["format"]) is not int:
        raise ValueError(f"has format {str(manifest['format'])[:20]!r}; this aero-planner reads format {FORMAT}")
    return manifest


def _field(manifest: dict[str, Any], name: str, kind: type) -> Any:
    value = manifest.get(name)
    if type(value) is not kind:
        raise ValueError(f"has a manifest without a proper {name!r}")
    return value


def _digest(folder: Path, name: str, size: int, target: Path | None) -> str:
    """Return the SHA-256 of a file of exactly `size` bytes, and copy it to `target` unless that is None."""
    path = folder
    for part in name.split("/"):
        path = path / part
        if path.is_symlink():
            raise ValueError(f"holds {name!r}, which is a link or another special file")
    try:
        status = path.stat()
    except OSError as error:
        raise ValueError(f"is incomplete: {name} is missing") from error
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"holds {name!r}, which is a link or another special file")
    if status.st_size != size:
        raise ValueError(f"is damaged: {name} has {status.st_size} bytes, its manifest says {size}")
    digest = hashlib.sha256()
    with contextlib.ExitStack() as stack:
        file = stack.enter_context(open_user_file(path))
        output = None
        if target is not None:
            target.parent.mkdir(parents=True, exist_ok=True)
            output = stack.enter_context(target.open("wb"))
        for chunk in _chunks(file, size):
            digest.update(chunk)
            if output is not None:
                output.write(chunk)
    return digest.hexdigest()
