import hashlib
import io
import json
import os
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
import warp as wp

from aero_planner import PlannerConfig
from aero_planner.cli import main
from aero_planner.deploy.bundle import cpu_target, open_bundle
from aero_planner.deploy.export import pack, write_manifest

STRUCTURE = dict(PlannerConfig().structure())
CUBIN = "kernels/wp_some_1234567/wp_some_1234567.sm87.cubin"


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder for the private copies, which the tests check for leftovers."""
    place = tmp_path / "temporary"
    place.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    return place


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bundle with dummy kernels."""
    place = tmp_path / "bundle"
    (place / CUBIN).parent.mkdir(parents=True)
    (place / CUBIN).write_bytes(b"\x7fELF" + bytes(3000))
    (place / CUBIN).with_name("wp_some_1234567.meta").write_text("{}")
    (place / "graph/cpu").mkdir(parents=True)
    (place / "graph/cpu/planner.wrp").write_bytes(bytes(2000))
    (place / "config.yaml").write_text("costs:\n  q_track: 7.5\n")
    write_manifest(place, [87], True)
    return place


def packed(folder: Path) -> Path:
    path = folder.with_suffix(".tar")
    pack(folder, path, json.loads((folder / "manifest.json").read_text()))
    return path


def changed(folder: Path, **fields: object) -> Path:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))
    return folder


def leftovers(temporary: Path) -> list[str]:
    return os.listdir(temporary)


@pytest.mark.parametrize("form", [lambda folder: folder, packed])
def test_a_bundle_is_copied_and_the_copy_is_removed(folder: Path, temporary: Path, form: Callable[[Path], Path]):
    cache = wp.config.kernel_cache_dir
    with open_bundle(form(folder)) as bundle:
        assert bundle.architectures == (87,) and bundle.cpu == cpu_target() and bundle.warp == wp.config.version
        assert "sm_87, CPU" in bundle.describe()
        (folder / CUBIN).write_bytes(b"something else")
        assert (bundle.folder / CUBIN).read_bytes()[:4] == b"\x7fELF"
        assert bundle.config_file.read_text() == "costs:\n  q_track: 7.5\n"
        assert not (bundle.folder / "graph").exists()  # not needed by a planner
        bundle.activate(PlannerConfig(), "cpu")
        assert wp.config.kernel_cache_dir == str(bundle.folder / "kernels")
        assert bundle.compiled() == []
        (bundle.folder / "kernels/new.o").touch()
        assert bundle.compiled() == ["kernels/new.o"]
    assert wp.config.kernel_cache_dir == cache and not leftovers(temporary)


@pytest.mark.parametrize("form", ["ustar", "gnu"])
def test_tar_files_made_by_tar_are_read(folder: Path, form: str):
    path = folder.with_suffix(".tar")
    subprocess.run(["tar", f"--format={form}", "-C", str(folder), "-cf", str(path), "."], check=True)
    with open_bundle(path) as bundle:
        assert (bundle.folder / CUBIN).stat().st_size == 3004


def test_long_names_in_gnu_tars_format_are_read(folder: Path):
    name = f"kernels/{'long_' * 40}.o"
    (folder / name).write_bytes(b"kernel")
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["files"][name] = {"size": 6, "sha256": hashlib.sha256(b"kernel").hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    path = folder.with_suffix(".tar")
    subprocess.run(["tar", "--format=gnu", "-C", str(folder), "-cf", str(path), "."], check=True)
    with open_bundle(path) as bundle:
        assert (bundle.folder / name).read_bytes() == b"kernel"


def test_another_structure_is_refused_but_live_parameters_may_differ(folder: Path):
    with open_bundle(folder) as bundle:
        bundle.activate(PlannerConfig().replace({"costs.q_track": 1.0}), "cpu")
        with pytest.raises(ValueError, match=r"is for sampling.samples = \d+, the configuration says 64: export it"):
            bundle.activate(PlannerConfig().replace({"sampling.samples": 64}), "cpu")


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"warp": "1.13.0"}, r"is for another Warp \(1.13.0; here is "),
        ({"planner": "0" * 64}, r"is for another state of aero-planner \(000000000000; here is "),
        ({"structure": STRUCTURE | {"sampling.new": 1}}, r"is for sampling.new = 1, .* says None"),
        ({"structure": {}}, r"is for anchors.columns = None, the configuration says 5"),
        ({"cpu": "other"}, r"has kernels for another CPU \(other; here is "),
        ({"cpu": None}, r"has kernels for GPUs only: .* --cpu on this machine"),
    ],
)
def test_bundles_for_other_versions_and_processors_are_refused(folder: Path, fields: dict[str, object], problem: str):
    cache = wp.config.kernel_cache_dir
    with open_bundle(changed(folder, **fields)) as bundle, pytest.raises(ValueError, match=problem):
        bundle.activate(PlannerConfig(), "cpu")
    assert wp.config.kernel_cache_dir == cache


def test_another_gpu_is_refused(folder: Path):
    with open_bundle(folder) as bundle:
        bundle.check_processor(87)
        with pytest.raises(ValueError, match=r"has kernels for sm_87, the device is an sm_90: .* --arch sm_90"):
            bundle.check_processor(90)


def cut(folder: Path) -> None:
    (folder / CUBIN).write_bytes((folder / CUBIN).read_bytes()[:-1])


def flip(folder: Path) -> None:
    (folder / CUBIN).write_bytes((folder / CUBIN).read_bytes()[:-1] + b"\x01")


def link(folder: Path) -> None:
    (folder / CUBIN).rename(folder.parent / "elsewhere")
    (folder / CUBIN).symlink_to(folder.parent / "elsewhere")


def link_above(folder: Path) -> None:
    (folder / "kernels").rename(folder.parent / "elsewhere")
    (folder / "kernels").symlink_to(folder.parent / "elsewhere")


def list_file(name: str, description: object) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        files = json.loads((folder / "manifest.json").read_text())["files"]
        changed(folder, files=files | {name: description})

    return act


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (lambda folder: (folder / "manifest.json").unlink(), "has no manifest.json"),
        (lambda folder: (folder / "manifest.json").write_text("{"), "has a manifest.json that is not JSON"),
        (lambda folder: (folder / "manifest.json").write_text("[" * 100_000), "has a manifest.json that is not JSON"),
        (lambda folder: (folder / "manifest.json").write_text("[1]"), "manifest.json that does not describe a bundle"),
        (lambda folder: (folder / "manifest.json").write_text(" " * 5_000_000), "manifest.json that does not describe"),
        (lambda folder: changed(folder, format=2), "has format '2'; this aero-planner reads format 1"),
        (lambda folder: changed(folder, files=[]), "has a manifest without a proper 'files'"),
        (lambda folder: changed(folder, files={}), "has no config.yaml"),
        (lambda folder: changed(folder, warp=1), "has a manifest without a proper 'warp'"),
        (lambda folder: changed(folder, architectures=["87"]), "other than whole numbers in 'architectures'"),
        (lambda folder: (folder / CUBIN).unlink(), f"is incomplete: {CUBIN} is missing"),
        (lambda folder: (folder / "graph/cpu/planner.wrp").unlink(), "is incomplete: graph/cpu/planner.wrp is missing"),
        (cut, f"is damaged: {CUBIN} has 3003 bytes, its manifest says 3004"),
        (flip, f"is damaged: {CUBIN} has another checksum"),
        (link, "which is a link"),
        (link_above, "which is a link"),
        (list_file("kernels/../../secret", {"size": 1, "sha256": ""}), "is not a plain relative path"),
        (list_file("/etc/passwd", {"size": 1, "sha256": ""}), "is not a plain relative path"),
        (list_file("kernels/a\nb", {"size": 1, "sha256": ""}), "is not a plain relative path"),
        (list_file("kernels/a", {"size": "1", "sha256": ""}), "does not say size and sha256 of kernels/a"),
        (list_file("kernels/a", None), "does not say size and sha256 of kernels/a"),
        (list_file("kernels/a", {"size": 2**40, "sha256": ""}), "is larger than any bundle"),
        (list_file("kernels", {"size": 4096, "sha256": ""}), "is a link or another special file"),
    ],
)
def test_damaged_folders_are_refused(
    folder: Path, temporary: Path, damage: Callable[[Path], object], problem: str
):  # fmt: skip
    damage(folder)
    with pytest.raises(ValueError) as error:
        open_bundle(folder)
    assert problem in str(error.value) and "\n" not in str(error.value)
    assert str(error.value).endswith(": export it again with 'aero-planner export', or copy it again.")
    assert not leftovers(temporary)


def tar_with(folder: Path, entry: tarfile.TarInfo, content: bytes = b"") -> Path:
    """Return the bundle as a tar file with an additional first entry."""
    first = io.BytesIO()
    with tarfile.open(fileobj=first, mode="w", format=tarfile.GNU_FORMAT) as archive:
        archive.addfile(entry, io.BytesIO(content))
        end = archive.offset
    path = packed(folder)
    path.write_bytes(first.getvalue()[:end] + path.read_bytes())
    return path


def entry(name: str, kind: bytes = tarfile.REGTYPE, *, size: int = 0, to: str = "") -> tarfile.TarInfo:
    result = tarfile.TarInfo(name)
    result.type, result.size, result.linkname = kind, size, to
    return result


@pytest.mark.parametrize(
    ("trick", "problem"),
    [
        (entry("../escaped"), "is not a plain relative path"),
        (entry("kernels/../../escaped"), "is not a plain relative path"),
        (entry("/escaped"), "is not a plain relative path"),
        (entry("..", tarfile.DIRTYPE), "is not a plain relative path"),
        (entry("/escaped", tarfile.DIRTYPE), "is not a plain relative path"),
        (entry("kernels", tarfile.SYMTYPE, to="/tmp"), "is a link"),
        (entry("config.yaml", tarfile.LNKTYPE, to="/etc/passwd"), "is a link"),
        (entry("pipe", tarfile.FIFOTYPE), "is a link or another special file"),
        (entry("device", tarfile.CHRTYPE), "is a link or another special file"),
        (entry("sparse", tarfile.GNUTYPE_SPARSE), "is a link or another special file"),
        # Long names, for which GNU tar has an extension.
        (entry("kernels/../../" + "a" * 120), "is not a plain relative path"),
        (entry("/" + "a" * 120), "is not a plain relative path"),
        (entry("a" * 120, tarfile.SYMTYPE, to="/tmp"), "is a link"),
        (entry("a", tarfile.SYMTYPE, to="/" + "a" * 120), "is a link"),
        (entry("a" * 2000), "holds a name of 2001 bytes"),
        (entry("pax", tarfile.XHDTYPE), "in pax format, which is not read; pack the folder with tar --format=gnu"),
        (entry("config.yaml"), "holds 'config.yaml' twice"),
        (entry("kernels"), "holds 'kernels/"),
    ],
)
def test_malicious_tar_entries_are_refused(folder: Path, temporary: Path, trick: tarfile.TarInfo, problem: str):
    path = tar_with(folder, trick)
    before = sorted(folder.parent.rglob("*"))
    with pytest.raises(ValueError, match=problem):
        open_bundle(path)
    assert sorted(folder.parent.rglob("*")) == before and not leftovers(temporary)


def test_false_sizes_allocate_nothing(folder: Path):
    for size in (2**33, 2**60):
        header = entry("config.yaml", size=size).tobuf(tarfile.GNU_FORMAT)
        folder.with_suffix(".tar").write_bytes(header + bytes(10_000))
        with pytest.raises(ValueError, match="is larger than any bundle"):
            open_bundle(folder.with_suffix(".tar"))
    folder.with_suffix(".tar").write_bytes(entry("config.yaml", size=10_001).tobuf() + bytes(10_000))
    with pytest.raises(ValueError, match="is truncated"):
        open_bundle(folder.with_suffix(".tar"))


def test_truncated_tar_files_are_refused(folder: Path, temporary: Path):
    path = packed(folder)
    whole = path.read_bytes()
    used = len(whole.rstrip(b"\0"))
    for size in range(0, used, 500):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"truncated|neither a folder nor a whole tar file|incomplete|no manifest"):
            open_bundle(path)
    assert not leftovers(temporary)


@pytest.mark.parametrize("content", [b"", b"not a bundle", bytes(4096), b"\x1f\x8b\x08" + bytes(600), b"\xff" * 2048])
def test_garbage_is_refused(tmp_path: Path, content: bytes):
    path = tmp_path / "bundle.tar"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="is neither a folder nor a whole tar file"):
        open_bundle(path)


def test_the_command_line_reports_errors_in_one_line(
    folder: Path, tmp_path: Path, temporary: Path, capsys: pytest.CaptureFixture[str]
):
    other = tmp_path / "other.yaml"
    other.write_text("sampling:\n  samples: 64\n")
    flip(shutil.copytree(folder, tmp_path / "damaged"))
    for command in ("run", "preflight"):
        for arguments, problem in (
            (["--bundle", str(tmp_path / "absent.tar")], "absent.tar can't be read: No such file"),
            (["--bundle", str(tmp_path / "damaged")], "is damaged"),
            (["--bundle", "/dev/zero"], "is neither a folder nor a whole tar file"),
            (["--bundle", str(folder), "--config", str(other)], "the configuration says 64"),
        ):
            assert main([command, *arguments]) == 2
            lines = capsys.readouterr().err.strip().splitlines()
            assert len([line for line in lines if line.startswith("aero-planner: ")]) == 1
            assert problem in lines[-1] and lines[-1].endswith(".")
    assert not leftovers(temporary)
