"""The pins of constraints.txt and the scripts that read and write them."""

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
SCRIPTS = ROOT / "scripts"


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder scripts/ on the path of imports."""
    monkeypatch.syspath_prepend(str(SCRIPTS))


def pins_of(*sections: str) -> str:
    return subprocess.run([SCRIPTS / "pins", *sections], check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize("section", ["Product", "Extras", "Tests", "Release"])
def test_every_pin_has_a_version_and_hashes(section: str):
    pins = pins_of(section).splitlines()[1:]
    assert len(pins) > 10
    for pin in pins:
        assert re.fullmatch(r"[\w.-]+==\S+( ; .+?)?( --hash=sha256:[0-9a-f]{64})+|", pin), pin


def requirements_of(*sections: str) -> list[Requirement]:
    """Return the pins that apply to this machine."""
    lines = (line.partition(" --hash")[0] for line in pins_of(*sections).splitlines() if "==" in line)
    return [pin for pin in map(Requirement, lines) if pin.marker is None or pin.marker.evaluate()]


def test_the_pins_of_the_product_hold_the_versions_that_the_tests_run_with():
    for pin in requirements_of("Product", "Extras", "Tests"):
        assert pin.specifier.contains(metadata.version(pin.name)), f"{pin.name}: run scripts/setup dev"


def test_pip_refuses_a_file_whose_hash_is_not_pinned(tmp_path: Path):
    wheel = tmp_path / "aero_hash_probe-1.0-py3-none-any.whl"
    wheel.write_bytes(b"not what was pinned")
    pins = tmp_path / "pins.txt"
    pins.write_text(f"aero-hash-probe==1.0 --hash=sha256:{'0' * 64}\n")
    options = ["--require-hashes", "--no-deps", "--no-index", "--find-links", tmp_path, "--target", tmp_path / "out"]
    command = [sys.executable, "-m", "pip", "install", *options, "-r", pins]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode and "DO NOT MATCH THE HASHES" in done.stderr


def test_pinning_strips_only_hashes(scripts: None):
    import pin  # type: ignore[import-not-found]

    text = "## Product\na.b==1 ; python_version >= '3.12' --hash=sha256:00 --hash=sha256:11\nc==2\n"
    assert pin.strip_hashes(text) == ["## Product", "a.b==1 ; python_version >= '3.12'", "c==2"]
    assert pin.name_and_version("Ruamel.Yaml_x==1.0.post1 --hash=sha256:0") == "ruamel-yaml-x==1.0.post1"


def test_the_audit_fails_on_a_vulnerability_and_says_when_it_could_not_run(
    scripts: None, capsys: pytest.CaptureFixture[str]
):
    import audit  # type: ignore[import-not-found]

    sound = {"name": "a", "version": "1", "vulns": []}
    skipped = {"name": "b", "skip_reason": "not found"}
    broken = {"name": "c", "version": "2", "vulns": [{"id": "CVE-1", "fix_versions": ["2.1"]}]}
    assert audit.report([sound, skipped]) == 0
    assert "1 of 2 packages were audited; not in the index: b" in capsys.readouterr().out
    assert audit.report([sound, broken]) == 1
    assert "c 2: CVE-1; fixed in 2.1" in capsys.readouterr().err
    assert audit.report([skipped]) == 0
    assert "NOT AUDITED" in capsys.readouterr().err
