"""What a drone needs, made on another machine: kernels compiled ahead, configuration, graph for the C++ host.

The bundle that comes of it is described, and read, in `aero_planner.deploy.bundle`. No GPU is needed.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib.metadata
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

import numpy as np
import warp as wp

from aero_planner.config import PlannerConfig
from aero_planner.deploy.aot import compile_ahead, kernels_in
from aero_planner.deploy.bundle import (
    CONFIG,
    FORMAT,
    GRAPH,
    KERNELS,
    MANIFEST,
    cpu_target,
    planner_digest,
    structure_of,
)
from aero_planner.plan import Goal, VehicleState
from aero_planner.planner import Planner, _find_device
from aero_planner.warp_init import quieten

__all__ = ["export", "makes_graphs", "pack", "parse_architecture", "save_graph", "write_manifest"]

_KEPT = (".cubin", ".ptx", ".o", ".meta")
"""What Warp loads; sources stay behind."""

_GRAPHS_SINCE = (1, 19)
"""First Warp whose graphs the C++ host, which is for Linux, is written for."""

_GRAPH_FILE = "planner.wrp"


def export(
    out: str | os.PathLike[str],
    *,
    config: str | os.PathLike[str] = "default",
    architectures: Iterable[int] = (),
    cpu: bool = False,
) -> dict[str, Any]:
    """Write a bundle.

    Args:
        out: folder, which must not exist or be empty, or file whose name ends in ".tar", which is replaced.
        config: preset, or file with parameters of the planner and, under `onboard:`, settings of the node.
        architectures: compute capabilities without the dot, such as 87 for a Jetson Orin. Where this machine has a GPU
            of one, its graph for the C++ host comes along.
        cpu: also for this machine's CPU, with its graph.

    Returns:
        The manifest.

    Raises:
        ValueError: the configuration is wrong, Warp can't compile for an architecture or for this CPU, nothing was
            asked for, or the place is taken.
        OSError: it can't be written.
    """
    wanted = sorted(set(architectures))
    if not wanted and not cpu:
        raise ValueError(
            "there is nothing to compile for: give --arch, such as --arch sm_87 for a Jetson Orin, or --cpu."
        )
    target = Path(os.path.abspath(out))
    packed = target.suffix == ".tar"
    if target.is_dir() if packed else target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise ValueError(f"{out} exists already; remove it, or give the bundle another name.")
    if not target.parent.is_dir():
        raise ValueError(f"the folder {target.parent} does not exist; make it, or put the bundle elsewhere.")
    text = _config_text(config)
    quieten()
    if cpu and not wp.is_cpu_available():
        raise ValueError("this Warp has no compiler for the CPU; leave out --cpu, or install Warp's own package.")
    work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        folder = work / "bundle"
        folder.mkdir(mode=0o755)
        (folder / CONFIG).write_text(text, encoding="utf-8")
        _compile_elsewhere(work, folder, wanted, cpu)
        _collect(work / "compiled", folder / KERNELS, cpu)
        manifest = write_manifest(folder, wanted, cpu)
        if packed:
            pack(folder, work / "bundle.tar", manifest)
            os.replace(work / "bundle.tar", target)
        else:
            os.replace(folder, target)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return manifest


def parse_architecture(text: str) -> int:
    """Return 87 for "sm_87"; ValueError where it is none."""
    match = re.fullmatch(r"(?:sm_)?(\d{2,3})", text)
    if match is None:
        raise ValueError(f"the architecture {text!r} is not understood; write it as sm_87 (Orin) or sm_90.")
    return int(match[1])


def makes_graphs() -> bool:
    """Return whether bundles have graphs of this machine's processors for the C++ host."""
    version = tuple(int(part) for part in re.findall(r"\d+", wp.config.version)[:2])
    return sys.platform == "linux" and version >= _GRAPHS_SINCE


def save_graph(config: PlannerConfig, points: int, path: Path, *, device: str = "cpu") -> Path:
    """Capture a plan, on one thread of the CPU or on a GPU, as a sequence of launches, and save it for the C++ host.

    Args:
        config: parameters; the live ones can be changed in the loaded graph, the structural ones cannot.
        points: P, the most points that a cloud may have.
        path: file to write; kernels go to a folder beside it. Arrays are bound by the names of `Planner.inputs` and
            `Planner.outputs`, and "points", "params", "seed", "tick", "previous_controls", "previous_end",
            "previous_turn", "previous_time".
        device: as for `Planner`.

    Returns:
        The file, with the ending ".wrp".
    """
    planner = Planner(config, device=device, threads=1)
    state = VehicleState(position=(0.0, 0.0, 0.0), velocity=(0.0, 0.0, 0.0), quaternion=(1.0, 0.0, 0.0, 0.0))
    planner.plan(state, Goal((5.0, 0.0, 0.0)), np.array([[2.0, 0.0, 0.0]]))  # loads the kernels
    planner.reserve(points)  # every launch is then as large as it can get
    planner.reset()
    work = planner._work
    names = ("seed", "tick", "previous_controls", "previous_end", "previous_turn", "previous_time")
    inputs = vars(planner.inputs) | {"points": planner.points, "params": planner._params}
    inputs |= {name: getattr(work, name) for name in names}
    wp.capture_save(planner._pipeline.record(), str(path), inputs=inputs, outputs=vars(planner.outputs))
    planner.close()
    return path.with_suffix(".wrp")


def _config_text(config: str | os.PathLike[str]) -> str:
    """Return the file that `config` names as it is, or the whole text of a preset; ValueError where it is wrong."""
    from aero_planner.config.file import config_from_name, format_config, read_text
    from aero_planner.onboard.settings import OnboardConfig, check_together, format_onboard, load_flight_config

    if str(config) not in PlannerConfig.presets() and Path(config).exists():
        check_together(*load_flight_config(config))
        return read_text(config)
    planner = config_from_name(config)
    check_together(planner, OnboardConfig())
    return f"{format_config(planner)}\n{format_onboard(OnboardConfig())}"


def _compile_elsewhere(work: Path, folder: Path, architectures: list[int], cpu: bool) -> None:
    """Compile in a process of its own, since Warp does not compile again what is loaded in this one."""
    command = [sys.executable, "-m", __name__, str(work), str(folder), str(int(cpu)), *map(str, architectures)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace")
    if done.returncode:
        last = done.stderr.strip().splitlines()[-1:] or [f"the compiler's process ended with {done.returncode}."]
        raise ValueError(last[0].removeprefix("ValueError: "))


def _compile(work: Path, folder: Path, cpu: bool, architectures: list[int]) -> None:
    from aero_planner.onboard.settings import load_flight_config

    planner, onboard = load_flight_config(folder / CONFIG)
    compile_ahead(work / "compiled", architectures=architectures, cpu=cpu, config=planner)
    for processor, device in _capturable(architectures, cpu).items():
        place = folder / GRAPH / processor
        place.mkdir(parents=True)
        with kernels_in(work / "compiled"):
            save_graph(planner, onboard.lidar.points_max, place / _GRAPH_FILE, device=device)
        about = [wp.config.version, str(len(planner.kinds)), *(_cpu_features() if device == "cpu" else ())]
        (place / "target.txt").write_text("".join(f"{line}\n" for line in about), encoding="ascii")


def _capturable(architectures: list[int], cpu: bool) -> dict[str, str]:
    """Return, for each processor whose graph is wanted and which this machine has, a device that has it."""
    if not makes_graphs():
        return {}
    found = {"cpu": "cpu"} if cpu else {}
    for device in wp.get_cuda_devices():
        if device.arch in architectures:
            found.setdefault(f"sm_{device.arch}", str(device))
    return found


def _cpu_features() -> list[str]:
    """Return triple and features of this CPU, as the C++ host sees them."""
    library = ctypes.CDLL(str(Path(wp.__file__ or "").parent / "bin" / "warp-clang.so"))
    words = []
    for name in ("wp_get_cpu_target_triple", "wp_get_host_cpu_features"):
        function = getattr(library, name)
        function.argtypes, function.restype = [], ctypes.c_char_p
        words.append(function().decode())
    return words


def _collect(compiled: Path, kernels: Path, cpu: bool) -> None:
    """Copy what Warp loads, without the CPU's part where it is not wanted."""
    for binary in sorted(path for path in compiled.rglob("*") if path.suffix in _KEPT[:-1]):
        if binary.suffix == ".o" and not cpu:
            continue
        place = kernels / binary.parent.name
        place.mkdir(parents=True, exist_ok=True)
        for path in (binary, *binary.parent.glob("*.meta")):
            shutil.copyfile(path, place / path.name)


def write_manifest(folder: Path, architectures: list[int], cpu: bool) -> dict[str, Any]:
    """Write the manifest of what lies in `folder`, and return it."""
    from aero_planner.onboard.settings import load_flight_config

    _find_device("cpu")
    files = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        name = path.relative_to(folder).as_posix()
        files[name] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    try:
        version = importlib.metadata.version("aero-planner")
    except importlib.metadata.PackageNotFoundError:
        version = "(not installed)"
    manifest = {
        "format": FORMAT,
        "created": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "aero_planner": version,
        "planner": planner_digest(),
        "warp": wp.config.version,
        "python": platform.python_version(),
        "architectures": architectures,
        "cpu": cpu_target() if cpu else None,
        "graphs": sorted(path.parent.name for path in folder.glob(f"{GRAPH}/*/{_GRAPH_FILE}")),
        "structure": structure_of(load_flight_config(folder / CONFIG)[0]),
        "files": files,
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
    return manifest


def pack(folder: Path, path: Path, manifest: dict[str, Any]) -> None:
    """Write the files of a manifest as a tar file, the manifest first."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name in (MANIFEST, *manifest["files"]):
            entry = archive.gettarinfo(folder / name, name)
            entry.uid = entry.gid = 0
            entry.uname = entry.gname = ""
            with (folder / name).open("rb") as file:
                archive.addfile(entry, file)


if __name__ == "__main__":
    _compile(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3] == "1", [int(one) for one in sys.argv[4:]])
