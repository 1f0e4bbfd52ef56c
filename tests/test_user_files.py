"""Files are opened for reading in one place, `aero_planner.user_file`, which refuses pipes and devices."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = (ROOT / "aero_viz", ROOT / "planner" / "aero_planner")
METHODS = {"open", "read_text", "read_bytes"}
"""Methods of a path that open it."""
FUNCTIONS = {
    "open", "io.open", "os.open", "np.load", "np.fromfile", "np.loadtxt", "np.genfromtxt",
    "np.memmap", "mmap.mmap", "iio.imread", "Image.open", "laspy.open", "trimesh.load", "sqlite3.connect", "ULog",
    "tarfile.open", "ZipFile", "gzip.open", "bz2.open", "lzma.open",
}  # fmt: skip
"""Functions that open a file."""
OPENED = ("file", "lines", "io.BytesIO(", "open_user_file(", "_lines(")
"""Starts of first arguments that are open already."""
WRITTEN = ("os.devnull", "target", "partial")
"""Starts of first arguments that are written."""
OWN = {
    "aero_planner/deploy/bundle.py": {"path.read_bytes", "Path('/proc/cpuinfo').read_bytes"},  # own sources
    "aero_planner/deploy/export.py": {"path.read_bytes", "(folder / name).open"},  # what it has compiled
    "aero_planner/onboard/failsafe_process.py": {"open"},  # standard input
    "aero_planner/onboard/preflight.py": {"Path('/proc/sys/net/core/rmem_max').read_text"},
    "aero_planner/onboard/transport.py": {"os.open"},  # a serial line
    "aero_planner/onboard/tuning_link.py": {"channel.open"},  # a sealed message
    "aero_planner/output_files.py": {"os.open"},  # to write
    "aero_planner/user_file.py": {"os.open"},
    "aero_viz/browser.py": {"open"},  # the start of an installed browser
    "aero_viz/cli/page.py": {"study.open"},  # no file
    "aero_viz/cli/serving.py": {"webbrowser.open"},
    "aero_viz/cli/tune.py": {"shown.open"},  # no file
    "aero_viz/dashboard/panels/share.py": {"path.read_bytes"},  # what it has just written
    "aero_viz/dashboard/snapshot.py": {"iio.imread"},  # a screenshot in memory
    "aero_viz/evaluation/machine.py": {"Path('/proc/cpuinfo').read_text"},
    "aero_viz/plain_sqlite.py": {"sqlite3.connect"},
    "aero_viz/reader_process.py": {"Path(f'/proc/{process}/io').read_text"},
    "aero_viz/recordings/odometry_cache.py": {"np.load"},  # its own cache
    "aero_viz/recordings/ouster.py": {"spool.open"},  # its own temporary file
    "aero_viz/rig/process.py": {"self._log_file.read_text"},
    "aero_viz/rig/px4_process.py": {"self._output.read_text", "open"},  # a lock of PX4
    "aero_viz/session/drone_tuning.py": {"self._channel.open"},  # a sealed message
}
"""Calls that read what the program, or the system, has written."""


def reading_calls(tree: ast.AST) -> Iterator[str]:
    """Yield the dotted names of the calls that open a file for reading."""
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call):
            continue
        name, first = ast.unparse(call.func), ast.unparse(call.args[0]) if call.args else ""
        is_method = name not in FUNCTIONS
        if is_method and not (isinstance(call.func, ast.Attribute) and call.func.attr in METHODS):
            continue
        mode = call.args[0 if is_method else 1 :][:1]
        is_written = bool(mode) and isinstance(mode[0], ast.Constant) and str(mode[0].value)[:1] in ("w", "a", "x")
        if not is_written and not first.startswith(OPENED + WRITTEN):
            yield name


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_nothing_else_opens_the_files_of_a_user(package: Path):
    found: dict[str, set[str]] = {}
    for file in sorted(package.rglob("*.py")):
        if calls := set(reading_calls(ast.parse(file.read_text(encoding="utf-8")))):
            found[str(file.relative_to(package.parent))] = calls
    expected = {name: calls for name, calls in OWN.items() if name.startswith(package.name)}
    assert found == expected, "open the files of a user with aero_planner.user_file"


def test_the_rule_finds_what_opens_files():
    text = "open(p)\np.open()\np.open('rb')\np.read_text()\nnp.load(p)\nopen(p, 'r+')\nsqlite3.connect(p)"
    assert len(list(reading_calls(ast.parse(text)))) == 7
    text = "open(p, 'w')\np.open('ab')\nnp.load(io.BytesIO(b))\nlaspy.open(open_user_file(p))\nnp.loadtxt(lines)"
    assert list(reading_calls(ast.parse(text))) == []
