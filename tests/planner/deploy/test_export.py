import hashlib
import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warp as wp

from aero_planner.cli import main
from aero_planner.config import PlannerConfig
from aero_planner.deploy.aot import kernels_of_planner
from aero_planner.deploy.export import makes_graphs, parse_architecture
from aero_planner.device.kernel_tuning import CPU, CUDA
from aero_planner.onboard.bundle_export import export_bundle

PLAN = """
import sys, zlib
from aero_planner import Goal, Planner, PlannerConfig, VehicleState
from aero_planner.deploy.bundle import open_bundle

device, path, lost = sys.argv[1:]
bundle = open_bundle(path) if path else None
if bundle:
    bundle.activate(PlannerConfig(), device)
    for kernel in sorted(bundle.folder.rglob("*.o"))[: int(lost)]:
        kernel.unlink()
state = VehicleState([0, 0, 2], [4, 0, 0], [1, 0, 0, 0])
plan = Planner(device=device).plan(state, Goal([30, 0, 2]), [[5.0, 0, 2], [3.0, 1, 2]])
print(plan.status.name, zlib.crc32(plan.controls.tobytes() + plan.positions.tobytes()))
if bundle:
    print(len(bundle.compiled()))
    bundle.close()
"""

SIGNALLED = """
import os, signal, sys
from aero_planner import cli

def send(frame, event, argument):
    # Profiles the program: sends the signal when the function makes or removes the temporary folder.
    if (event, frame.f_code.co_name) == (sys.argv[1], sys.argv[2]):
        sys.setprofile(None)
        print("sent", flush=True)
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):  # the handler is called in here
            pass

sys.setprofile(send)
sys.exit(cli.main(["export", *sys.argv[3:]]))
"""


def plan(device: str, bundle: Path | None, *, lost: int = 0, cache: Path | None = None) -> list[str]:
    """Plan in a new process with a bundle without its first `lost` kernels; return the lines printed."""
    environment = os.environ | ({"WARP_CACHE_PATH": str(cache)} if cache else {})
    command = [sys.executable, "-c", PLAN, device, str(bundle or ""), str(lost)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()


def architecture_of(cubin: bytes) -> int:
    """Return the architecture from e_flags in the ELF header of a CUDA binary, whose layout depends on the ABI."""
    assert cubin[:4] == b"\x7fELF" and struct.unpack_from("<H", cubin, 18) == (190,)  # EM_CUDA
    (flags,) = struct.unpack_from("<I", cubin, 48)
    return (flags >> 8 if cubin[8] >= 8 else flags) & 0xFF


def test_kernels_are_for_the_requested_processors(bundle: Path):
    cubins = sorted(bundle.glob("kernels/*/*.sm87.cubin"))
    assert len(cubins) > 20 and {architecture_of(path.read_bytes()) for path in cubins} == {87}
    # Kernels for a GPU may process one sample or point per thread, and then have another hash.
    objects = sorted(bundle.glob("kernels/*/*.o"))
    for tuning, paths in ((CUDA, cubins), (CPU, objects)):
        modules = {kernel.module.name for kernel, _ in kernels_of_planner(PlannerConfig(), tuning)}
        assert {re.sub(r"^wp_|_[0-9a-f]{7}\..*$", "", path.name) for path in paths} == modules
    assert {path.suffix for path in bundle.glob("kernels/*/*")} == {".cubin", ".o", ".meta"}  # no sources


def test_the_manifest_describes_every_file(bundle: Path, bundle_config: Path):
    manifest = json.loads((bundle / "manifest.json").read_text())
    assert (bundle / "config.yaml").read_bytes() == bundle_config.read_bytes()
    assert manifest["architectures"] == [87] and manifest["warp"] == wp.config.version and manifest["format"] == 1
    assert manifest["structure"]["sampling.samples"] == PlannerConfig().sampling.samples
    files = {path.relative_to(bundle).as_posix(): path for path in bundle.rglob("*") if path.is_file()}
    assert manifest["files"].keys() == files.keys() - {"manifest.json"}
    for name, description in manifest["files"].items():
        content = files[name].read_bytes()
        assert description == {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def test_a_planner_with_a_bundle_compiles_nothing_and_plans_the_same(
    tmp_path: Path, device: str, request: pytest.FixtureRequest
):
    if device == "cpu":
        bundle = request.getfixturevalue("bundle")
    else:
        bundle = tmp_path / "here"
        export_bundle(bundle, architectures=[int(wp.get_device(device).arch)])
    cache = tmp_path / "cache"
    (compiled_here,) = plan(device, None)
    assert plan(device, bundle, cache=cache) == [compiled_here, "0"] and compiled_here.startswith("OK ")
    assert not any(path.is_file() for path in cache.rglob("*"))


def test_missing_kernels_are_compiled_and_reported(bundle: Path):
    _, compiled = plan("cpu", bundle, lost=1)
    assert int(compiled) > 0


def test_a_node_starts_from_a_bundle_without_a_compiler(bundle: Path, tmp_path: Path):
    cache, temporary = tmp_path / "cache", tmp_path / "temporary"
    cache.mkdir()
    temporary.mkdir()
    before = {path: path.stat().st_mtime_ns for path in bundle.rglob("*")}
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), "TMPDIR": str(temporary)}
    command = [sys.executable, "-m", "aero_planner", "run", "--bundle", str(bundle), "--goal", "5", "0", "2"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stderr is not None
        lines: list[str] = []
        kernels: set[str] = set()
        for line in process.stderr:
            lines.append(line)
            if "waiting for states, points and a goal" in line:
                kernels = {path.name for path in temporary.rglob("*") if path.is_file()}
                process.send_signal(signal.SIGTERM)
        assert process.wait(30.0) == 0
    text = "".join(lines)
    assert "a plan takes" in text and "bundle lacks" not in text
    assert kernels == {path.name for path in bundle.rglob("kernels/*/*")} | {"config.yaml"}
    assert not any(path.is_file() for path in (*cache.rglob("*"), *temporary.rglob("*")))
    assert {path: path.stat().st_mtime_ns for path in bundle.rglob("*")} == before


def test_preflight_checks_the_bundle(bundle: Path, tmp_path: Path):
    command = [sys.executable, "-m", "aero_planner", "preflight", "--bundle", str(bundle), "--listen", "0.1", "--json"]
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    found = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
    assert found["bundle"]["ok"] and "kernels for sm_87, CPU" in found["bundle"]["finding"]
    assert done.returncode == 2 and not found["LiDAR"]["ok"]  # nothing is connected


@pytest.mark.usefixtures("cpu_compiler")
def test_a_tar_file_replaces_an_older_one_on_request_only(tmp_path: Path, bundle_config: Path):
    out = tmp_path / "drone.tar"
    out.write_text("older")
    with pytest.raises(ValueError, match=r"drone\.tar exists already; add --overwrite to replace it"):
        export_bundle(out, config=bundle_config, cpu=True)
    assert out.read_text() == "older"
    manifest = export_bundle(out, config=bundle_config, cpu=True, overwrite=True)
    assert out.stat().st_size > 100_000
    assert manifest["graphs"] == (["cpu"] if makes_graphs() else [])
    assert os.listdir(tmp_path) == ["drone.tar"]
    assert plan("cpu", out)[1] == "0"


@pytest.mark.usefixtures("cpu_compiler")
def test_sigterm_ends_an_export_and_leaves_nothing(tmp_path: Path):
    command = [sys.executable, "-m", "aero_planner", "export", str(tmp_path / "drone.tar"), "--cpu"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        while not list(tmp_path.iterdir()) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        try:
            printed = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert (process.returncode, printed, list(tmp_path.iterdir())) == (130, ("", ""), [])


@pytest.mark.parametrize(("event", "function"), [("return", "mkdtemp"), ("call", "rmtree")])
def test_sigterm_while_the_temporary_folder_is_made_or_removed_leaves_nothing(
    tmp_path: Path, event: str, function: str
):
    out = str(tmp_path / "drone.tar")
    command = [sys.executable, "-c", SIGNALLED, event, function, out, "--arch", "sm_12"]  # too old: ends with an error
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0)
    assert (done.stdout, os.listdir(tmp_path)) == ("sent\n", []), done.stderr
    if function == "mkdtemp":
        assert done.returncode == 130
    else:  # the program is ending because of the error, before or while the signal is sent again
        assert done.returncode in (130, 2, -signal.SIGINT)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["{out}"], "there is nothing to compile for: give --arch"),
        (["{out}", "--arch", "orin"], "the architecture 'orin' is not understood; write it as sm_87"),
        (["{out}", "--arch", "sm_12"], "kernels can't be compiled for architecture 12"),
        (["{taken}", "--cpu"], "exists already; remove it"),
        (["{taken}/file", "--cpu"], "exists already; remove it"),
        (["{absent}/out", "--cpu"], "absent; create it first"),
        (["{out}", "--cpu", "--config", "papr"], "'papr' is neither a preset (did you mean 'paper'?) nor a file"),
        (["{out}", "--cpu", "--config", "{bad}"], "line 1: unknown section 'cost'"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], problem: str
):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken/file").touch()
    (tmp_path / "bad.yaml").write_text("cost:\n  q_track: 1\n")
    names = {name: str(tmp_path / name) for name in ("out", "taken", "absent")} | {"bad": str(tmp_path / "bad.yaml")}
    assert main(["export", *(part.format(**names) for part in arguments)]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("aero-planner: ")]
    assert problem in line
    assert sorted(os.listdir(tmp_path)) == ["bad.yaml", "taken"] and os.listdir(tmp_path / "taken") == ["file"]


def test_architectures_are_parsed():
    assert [parse_architecture(text) for text in ("sm_87", "87", "sm_110")] == [87, 87, 110]
    for text in ("sm87", "sm_", "sm_90a", "8.7", ""):
        with pytest.raises(ValueError, match="is not understood; write it as sm_87"):
            parse_architecture(text)
