"""Update the hashes in constraints.txt: scripts/pin.py. `make pin` runs it after a version was changed there.

A pin gets the SHA-256 hashes of all files that the package registry holds for this version, so that every supported
platform and version of Python can install it. The section of the benchmarks stays without hashes: a registry may
offer its own build of PyTorch.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
WITHOUT_HASHES = "## Benchmarks"


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
    rows = [" \\\n    ".join([line, *hashes[name_and_version(line)]]) if "==" in line else line for line in lines]
    CONSTRAINTS.write_text("\n".join(rows) + "\n" + heading + rest)
    return 0


def strip_hashes(text: str) -> list[str]:
    """Return the lines of pins and comments without their hashes."""
    return re.sub(r"\s*\\\n\s*--hash=\S+", "", text).splitlines()


def find_hashes(pins: list[str]) -> dict[str, list[str]]:
    """Return the `--hash=..` options of every pin, by its normalized name and version.

    Raises:
        subprocess.CalledProcessError: uv failed, for example because a version does not exist.
    """
    with tempfile.NamedTemporaryFile("w", suffix=".in") as file:
        file.write("\n".join(pins))
        file.flush()
        uv = Path(sys.executable).with_name("uv")
        options = ["-q", "--no-deps", "--universal", "--generate-hashes", "--no-header", "--no-annotate"]
        compile_pins = [uv, "pip", "compile", *options, file.name]
        compiled = subprocess.run(compile_pins, check=True, capture_output=True, text=True).stdout
    blocks = re.split(r"\n(?=\S)", compiled.strip())
    return {name_and_version(block): re.findall(r"--hash=\S+", block) for block in blocks}


def name_and_version(pin: str) -> str:
    """Return `name==version` of a pin, with the name normalized as package registries do."""
    name, version = re.match(r"([\w.-]+)==([^\s;\\]+)", pin).groups()  # type: ignore[union-attr]
    return f"{re.sub(r'[-_.]+', '-', name).lower()}=={version}"


if __name__ == "__main__":
    sys.exit(main())
