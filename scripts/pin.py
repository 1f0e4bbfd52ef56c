"""Update the hashes in constraints.txt: scripts/pin.py. `make pin` runs it after a version was changed there.

A pin gets the SHA-256 hashes of its wheels for Linux (x86-64, aarch64) and the supported versions of Python, or that of
its sources if there is no wheel. The section of the benchmarks stays without hashes: a registry may offer its own build
of PyTorch.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from urllib.parse import unquote

import tomllib
from packaging.utils import parse_wheel_filename

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
WITHOUT_HASHES = "## Benchmarks"
PYTHONS = ("cp311", "cp312", "cp313")
INTERPRETERS = r"py3|py2\.py3|py2|cp3\d+"
PLATFORMS = r"any|(many)?linux.*_(x86_64|aarch64)"


def main() -> int:
    """Rewrite constraints.txt in place; return the exit code."""
    text = CONSTRAINTS.read_text()
    hashed, heading, rest = text.partition(WITHOUT_HASHES)
    lines = strip_hashes(hashed)
    try:
        hashes = find_hashes([line for line in lines if "==" in line])
    except subprocess.CalledProcessError as error:
        print(f"scripts/pin.py: constraints.txt is unchanged. uv said:\n{error.stderr.strip()}", file=sys.stderr)
        return 1
    rows = [" ".join([line, *hashes[name_and_version(line)]]) if "==" in line else line for line in lines]
    CONSTRAINTS.write_text("\n".join(rows) + "\n" + heading + rest)
    return 0


def strip_hashes(text: str) -> list[str]:
    """Return the lines of pins and comments without their hashes."""
    return re.sub(r" --hash=\S+", "", text).splitlines()


def find_hashes(pins: list[str]) -> dict[str, list[str]]:
    """Return the `--hash=..` options of every pin, by its normalized name and version.

    Raises:
        subprocess.CalledProcessError: uv failed, for example because a version does not exist.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, lock = Path(folder) / "pins.in", Path(folder) / "pylock.toml"
        source.write_text("\n".join(pins))
        uv = Path(sys.executable).with_name("uv")
        options = ["-q", "--no-deps", "--universal", "--format", "pylock.toml", "-o", lock]
        subprocess.run([uv, "pip", "compile", *options, source], check=True, capture_output=True, text=True)
        packages = tomllib.loads(lock.read_text())["packages"]
    return {name_and_version(f"{p['name']}=={p['version']}"): hash_options(p) for p in packages}


def hash_options(package: dict) -> list[str]:
    """Return the hashes of a package's wheels that a supported system can install, or of its sources without any."""
    wheels = [wheel for wheel in package.get("wheels", []) if is_supported(wheel["url"].rpartition("/")[2])]
    files = wheels or [package["sdist"]]
    return sorted(f"--hash=sha256:{file['hashes']['sha256']}" for file in files)


def is_supported(wheel: str) -> bool:
    """Return True for the file name of a wheel for a supported system and version of Python."""
    _, _, _, tags = parse_wheel_filename(unquote(wheel))
    return any(
        re.fullmatch(INTERPRETERS, tag.interpreter)
        and (tag.interpreter in PYTHONS or tag.abi in ("abi3", "none"))
        and re.fullmatch(PLATFORMS, tag.platform)
        for tag in tags
    )


def name_and_version(pin: str) -> str:
    """Return `name==version` of a pin, with the name normalized as package registries do."""
    name, version = re.match(r"([\w.-]+)==([^\s;]+)", pin).groups()  # type: ignore[union-attr]
    return f"{re.sub(r'[-_.]+', '-', name).lower()}=={version}"


if __name__ == "__main__":
    sys.exit(main())
