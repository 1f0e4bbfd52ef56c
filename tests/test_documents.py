"""What the documents tell a user to do and to read: commands parse, programs run, names and links exist."""

import contextlib
import fnmatch
import functools
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from documents import IGNORED, PATHS, ROOT, TEXTS, blocks, code, commands, prose

from aero_planner.cli import make_parser
from aero_planner.config import PlannerConfig
from aero_planner.onboard.flight_config import load_any
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.cli.commands import COMMANDS
from aero_viz.cli.parser import parse
from aero_viz.flight import FlightRules, StateNoise, VehicleModel
from aero_viz.rig.command import make_parser as make_rig_parser
from aero_viz.sensors import LidarModel

WORDS_MAX = 25_000
"""Words of all documents together."""
PARAMETERS = {
    info.path: info
    for kind in (PlannerConfig, OnboardConfig, LidarModel, VehicleModel, StateNoise, FlightRules)
    for info in kind.parameters()
}
PROGRAMS = [body for text in TEXTS.values() for body in blocks(text, "python")]
LINES = sorted({line for text in TEXTS.values() for line in commands(text)})
PROSE = sorted({words for text in TEXTS.values() for words in code(text)})
"""What the prose has between backticks."""


def calls(*programs: str) -> list[list[str]]:
    """Return the arguments of the calls of a program in the shell blocks, without what the shell does around them."""
    parts = {part.strip() for line in LINES for part in re.split(r" && |; ", line)}
    return [shlex.split(part)[1:] for part in sorted(parts) if part.split()[0].rpartition("/")[2] in programs]


def named(program: str) -> list[list[str]]:
    """Return the words after the name of a program in the prose."""
    return [words.split()[1:] for words in PROSE if words.startswith(f"{program} ")]


@functools.cache
def flags(name: str) -> frozenset[str]:
    """Return the flags that a command of `aero-viz` has by its help."""
    with contextlib.redirect_stdout(io.StringIO()) as shown, contextlib.suppress(SystemExit):
        parse(COMMANDS, [*name.split(), "--help"], prog="aero-viz", description="")
    return frozenset(re.findall(r"--[a-z][a-z0-9.-]*[a-z0-9]", shown.getvalue()))


def test_the_documents_are_short():
    counts = {name: len(text.split()) for name, text in TEXTS.items()}
    assert sum(counts.values()) <= WORDS_MAX, counts
    assert counts["README.md"] < 900


def test_the_readme_names_every_command():
    text = TEXTS["README.md"]
    words = {word for part in (*code(text), *commands(text)) for word in part.split()}
    assert {name.split()[0] for name in COMMANDS} <= words


def name_of(words: list[str]) -> str:
    """Return the name of the command of `aero-viz` with which words begin."""
    return next(name for name in (" ".join(words[:2]), *words[:1], "no command") if name in (*COMMANDS, "no command"))


@pytest.mark.parametrize("arguments", calls("aero-viz"), ids=" ".join)
def test_a_command_of_aero_viz_parses(arguments: list[str]):
    parse(COMMANDS, arguments, prog="aero-viz", description="")


@pytest.mark.parametrize("words", named("aero-viz"), ids=" ".join)
def test_a_command_of_aero_viz_that_is_named_has_its_flags(words: list[str]):
    if words not in (["--help"], ["--version"]):
        assert {word for word in words if re.match(r"--[a-z]", word)} <= flags(name_of(words))


@pytest.mark.parametrize("arguments", calls("aero-planner"), ids=" ".join)
def test_a_command_of_aero_planner_parses(arguments: list[str]):
    if arguments[0] == "rig":
        make_rig_parser().parse_args(arguments[1:])
    else:
        make_parser([]).parse_args(arguments)


@pytest.mark.parametrize("words", named("aero-planner"), ids=" ".join)
def test_a_command_of_aero_planner_that_is_named_has_its_flags(words: list[str]):
    with contextlib.redirect_stdout(io.StringIO()) as shown, pytest.raises(SystemExit):
        (make_rig_parser() if words[0] == "rig" else make_parser([])).parse_args(
            ["--help"] if words[0] == "rig" else [words[0], *[w for w in words[1:2] if words[0] == "config"], "--help"]
        )
    assert [word for word in words if word.startswith("--") and word not in shown.getvalue()] == []


def test_every_target_of_make_exists():
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {words[0] for words in (*calls("make"), *named("make"))} <= set(targets)


MODULES = [words for words in (*calls("python"), *named("python")) if words[0] == "-m" and words[1:]]


@pytest.mark.parametrize("words", MODULES, ids=" ".join)
def test_a_module_runs_with_its_flags(words: list[str]):
    name = words[1].replace(".", "/")
    (file,) = [ROOT / path for path in PATHS if f"/{path}".endswith((f"/{name}.py", f"/{name}/__main__.py"))]
    known = "".join(path.read_text(encoding="utf-8") for path in (file, *(ROOT / "benchmarks").glob("*.py")))
    assert [flag for flag in words if flag.startswith("--") and f'"{flag}"' not in known] == []


def test_every_flag_in_the_prose_exists():
    sources = (*(ROOT / "planner/aero_planner").glob("*.py"), *(ROOT / "aero_viz/rig").glob("*.py"))
    others = (*sources, *(ROOT / "benchmarks").glob("*.py"), *(ROOT / "tests").glob("*/*.py"))
    known = {flag for name in COMMANDS for flag in flags(name)}
    known |= {flag for path in others for flag in re.findall(r'"(--[a-z0-9-]+)"', path.read_text(encoding="utf-8"))}
    known |= {"--help", "--version", "--no-deps"}
    unknown = {
        (name, flag)
        for name, text in TEXTS.items()
        for words in code(text)
        if words.startswith("--")
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z0-9.*-]*", words)
        if not fnmatch.filter(known, flag.rstrip("."))
    }
    assert not unknown


def test_every_parameter_exists():
    """Names of parameters stand in the prose and in commands, as values of flags."""
    sections = {path.partition(".")[0] for path in PARAMETERS}
    files = re.compile(r".*\.(py|json|csv|yaml|mcap|tar|log)")
    words = {*PROSE, *(re.split(r"[=:]", word)[0] for line in LINES for word in line.split())}
    names = {word for word in words if re.fullmatch(r"[a-z_]+\.[a-z_*0-9]+", word) and not files.fullmatch(word)}
    named = {name for name in names if name.partition(".")[0] in sections}
    assert len(named) > 40 and [name for name in sorted(named) if not fnmatch.filter(PARAMETERS, name)] == []


def test_every_file_in_the_prose_exists():
    files = {words for words in PROSE if re.fullmatch(r"[\w/-]+\.py|[\w/]+/", words) and words not in IGNORED}
    assert [words for words in files if not any(f"/{path}".endswith(f"/{words.rstrip('/')}") for path in PATHS)] == []


def test_every_document_that_the_code_names_exists():
    sources = [path for path in PATHS if path.endswith((".py", ".toml", "Makefile", ".h", ".cpp"))]
    named = {
        found for path in sources for found in re.findall(r"docs/\w+\.md", (ROOT / path).read_text(encoding="utf-8"))
    }
    assert named and named <= set(TEXTS)


@pytest.mark.parametrize("name", TEXTS)
def test_links_lead_somewhere(name: str):
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", prose(TEXTS[name])):
        target, _, anchor = link.partition("#")
        path = (ROOT / name).parent / target if target else ROOT / name
        assert path.exists(), link
        if anchor:
            titles = re.findall(r"^#+ (.*)$", prose(path.read_text(encoding="utf-8")), re.MULTILINE)
            assert anchor in [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles], link


@pytest.mark.parametrize("text", [body for text in TEXTS.values() for body in blocks(text, "yaml")])
def test_a_configuration_is_valid(text: str, tmp_path: Path):
    (tmp_path / "c.yaml").write_text(text)
    load_any(tmp_path / "c.yaml")


@pytest.mark.parametrize("program", PROGRAMS, ids=range(len(PROGRAMS)))
def test_a_program_runs_and_prints_its_results_only(program: str, tmp_path: Path):
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert (result.returncode, result.stderr) == (0, "")
    assert len(program.splitlines()) <= 15
    assert result.stdout.strip() and "Warp" not in result.stdout and "Module" not in result.stdout
