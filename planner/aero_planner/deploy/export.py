"""Export of a bundle: kernels compiled ahead of time, configuration, and the graph for the C++ host.

`aero_planner.deploy.bundle` describes and reads bundles. No GPU is needed to write one.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import warp as wp

from aero_planner.arrays import Workspace
from aero_planner.cli_util import installed_version
from aero_planner.composition import Composition
from aero_planner.config import PlannerConfig
from aero_planner.config.file import load_config
from aero_planner.deploy.aot import compile_ahead, kernels_in, load_kernels
from aero_planner.deploy.bundle import CONFIG, FORMAT, GRAPH, KERNELS, MANIFEST, cpu_target, planner_digest
from aero_planner.history import format_initial_state
from aero_planner.import_path import child_environment, module_command
from aero_planner.output_files import check_folder, check_output_files
from aero_planner.planner import Planner
from aero_planner.warp_init import init_warp

_BINARIES = (".cubin", ".ptx", ".o")
"""Files that Warp loads, besides their .meta files; sources are left out."""

_FIRST_WARP_WITH_GRAPHS = (1, 19)
"""First version of Warp whose graphs the C++ host reads; the host needs Linux."""

_GRAPH_FILE = "planner.wrp"


def export(
    out: str | os.PathLike[str],
    *,
    config: str,
    max_points: int,
    architectures: Iterable[int] = (),
    cpu: bool = False,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Write a bundle.

    Args:
        out: folder, which must be empty or not exist, or name of a file that ends in ".tar".
        config: text of the configuration file, which is stored unchanged.
        max_points: capacity of the graph for the C++ host, the largest number of points of a cloud.
        architectures: GPU compute capabilities without the dot, such as 87 for a Jetson Orin. If this machine has a
            GPU of one of them, the bundle contains its graph for the C++ host.
        cpu: True to include kernels and graph for this machine's CPU.
        overwrite: True to replace an existing tar file; a folder is never replaced.

    Returns:
        The manifest.

    Raises:
        ValueError: the configuration is wrong, Warp can't compile for an architecture or for this CPU, no processor
            was requested, or `out` exists.
        OSError: the bundle can't be written.
    """
    requested = sorted(set(architectures))
    if not requested and not cpu:
        raise ValueError(
            "there is nothing to compile for: give --arch, such as --arch sm_87 for a Jetson Orin, or --cpu."
        )
    target = Path(os.path.abspath(out))
    is_tar = target.suffix == ".tar"
    if is_tar:
        check_output_files(Path(out), overwrite=overwrite)
    elif target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise ValueError(f"{out} exists already; remove it, or give the bundle another name.")
    check_folder(Path(out))
    init_warp()
    if cpu and not wp.is_cpu_available():
        raise ValueError("this Warp has no compiler for the CPU; leave out --cpu, or install the Warp package of PyPI.")
    with tempfile.TemporaryDirectory(
        prefix=f".{target.name}.", dir=target.parent, ignore_cleanup_errors=True
    ) as temporary:
        work = Path(temporary)
        folder = work / "bundle"
        folder.mkdir(mode=0o755)
        (folder / CONFIG).write_text(config, encoding="utf-8")
        _compile_in_subprocess(work, folder, max_points, requested, cpu)
        _collect(work / "compiled", folder / KERNELS, cpu)
        manifest = write_manifest(folder, requested, cpu)
        if is_tar:
            pack(folder, work / "bundle.tar", manifest)
            os.replace(work / "bundle.tar", target)
        else:
            os.replace(folder, target)
    return manifest


def parse_architecture(text: str) -> int:
    """Return 87 for "sm_87" or "87"; raises ValueError for any other form."""
    match = re.fullmatch(r"(?:sm_)?(\d{2,3})", text)
    if match is None:
        raise ValueError(f"the architecture {text!r} is not understood; write it as sm_87 (Orin) or sm_90.")
    return int(match[1])


def makes_graphs() -> bool:
    """Return True if bundles contain graphs for the C++ host, for the processors of this machine."""
    version = tuple(int(part) for part in re.findall(r"\d+", wp.config.version)[:2])
    return sys.platform == "linux" and version >= _FIRST_WARP_WITH_GRAPHS


def save_graph(config: PlannerConfig, max_points: int, path: Path, *, device: str = "cpu") -> Path:
    """Capture a plan as a sequence of launches and save it for the C++ host.

    A graph for the CPU runs on one thread.

    Args:
        config: parameters; live ones can be changed in the loaded graph, structural ones can't.
        max_points: P, the largest number of points of a cloud.
        path: file to write; kernels go to a folder next to it. See `Planner.save_graph` for the names of the arrays.
        device: as for `Planner`.

    Returns:
        The path of the file, with the suffix ".wrp".
    """
    planner = Planner(config, device=device, threads=1)
    load_kernels(planner)
    planner.reserve(max_points)  # gives every launch its largest size
    planner.reset()
    saved = planner.save_graph(path)
    planner.close()
    return saved


def _compile_in_subprocess(work: Path, folder: Path, max_points: int, architectures: list[int], cpu: bool) -> None:
    # Warp does not compile kernels again that are already loaded in this process.
    arguments = [str(work), str(folder), str(max_points), str(int(cpu)), *map(str, architectures)]
    with subprocess.Popen(
        module_command(__name__, *arguments), env=child_environment(), stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, errors="replace",
    ) as process:  # fmt: skip
        try:
            _, errors = process.communicate()
        except BaseException:
            process.kill()
            process.wait()  # until it writes no more to the folder, which is removed next
            raise
    if process.returncode:
        last = errors.strip().splitlines()[-1:] or [f"the compiler process ended with {process.returncode}."]
        raise ValueError(last[0].removeprefix("ValueError: "))


def _compile(work: Path, folder: Path, max_points: int, cpu: bool, architectures: list[int]) -> None:
    config = load_config(folder / CONFIG)
    compile_ahead(work / "compiled", architectures=architectures, cpu=cpu, config=config)
    for processor, device in _local_devices(architectures, cpu).items():
        place = folder / GRAPH / processor
        place.mkdir(parents=True)
        with kernels_in(work / "compiled"):
            # A host plans like the node, which always avoids the ground.
            flown = config.replace({"costs.use_ground": True})
            save_graph(flown, max_points, place / _GRAPH_FILE, device=device)
        composition = Composition.of(config)
        kinds = [kind for stage in composition.stages for kind in (stage.arrays, stage.outputs) if kind is not None]
        (place / "state.txt").write_text(format_initial_state([Workspace, *kinds]), encoding="ascii")
        target = [wp.config.version, str(len(config.kinds)), *(_cpu_features() if device == "cpu" else ())]
        (place / "target.txt").write_text("".join(f"{line}\n" for line in target), encoding="ascii")


def _local_devices(architectures: list[int], cpu: bool) -> dict[str, str]:
    """Return a device of this machine for each requested processor whose graph can be captured here."""
    if not makes_graphs():
        return {}
    devices = {"cpu": "cpu"} if cpu else {}
    for device in wp.get_cuda_devices():
        if device.arch in architectures:
            devices.setdefault(f"sm_{device.arch}", str(device))
    return devices


def _cpu_features() -> list[str]:
    """Return the triple and the features of this CPU as the C++ host determines them."""
    library = ctypes.CDLL(str(Path(wp.__file__ or "").parent / "bin" / "warp-clang.so"))
    words = []
    for name in ("wp_get_cpu_target_triple", "wp_get_host_cpu_features"):
        function = getattr(library, name)
        function.argtypes, function.restype = [], ctypes.c_char_p
        words.append(function().decode())
    return words


def _collect(compiled: Path, kernels: Path, cpu: bool) -> None:
    """Copy the files that Warp loads, without those for the CPU if `cpu` is False."""
    for binary in sorted(path for path in compiled.rglob("*") if path.suffix in _BINARIES):
        if binary.suffix == ".o" and not cpu:
            continue
        place = kernels / binary.parent.name
        place.mkdir(parents=True, exist_ok=True)
        for path in (binary, *binary.parent.glob("*.meta")):
            shutil.copyfile(path, place / path.name)


def write_manifest(folder: Path, architectures: list[int], cpu: bool) -> dict[str, Any]:
    """Write the manifest of the files in `folder`, and return it."""
    init_warp()
    files = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        name = path.relative_to(folder).as_posix()
        files[name] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    manifest = {
        "format": FORMAT,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "aero_planner": installed_version("aero-planner"),
        "planner": planner_digest(),
        "warp": wp.config.version,
        "python": platform.python_version(),
        "architectures": architectures,
        "cpu": cpu_target() if cpu else None,
        "graphs": sorted(path.parent.name for path in folder.glob(f"{GRAPH}/*/{_GRAPH_FILE}")),
        "structure": dict(load_config(folder / CONFIG).structure()),
        "files": files,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return manifest


def pack(folder: Path, path: Path, manifest: dict[str, Any]) -> None:
    """Write the files of a manifest to a tar file, the manifest first."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name in (MANIFEST, *manifest["files"]):
            entry = archive.gettarinfo(folder / name, name)
            entry.uid = entry.gid = 0
            entry.uname = entry.gname = ""
            with (folder / name).open("rb") as file:
                archive.addfile(entry, file)


if __name__ == "__main__":
    _compile(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "1", [int(a) for a in sys.argv[5:]])
