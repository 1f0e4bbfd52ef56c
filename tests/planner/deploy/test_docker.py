"""The image for a Jetson: what its Dockerfile copies and runs, and the first process of its container."""

import fnmatch
import json
import re
import signal
import subprocess
from pathlib import Path

import pytest

from aero_planner.cli import main

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "planner" / "docker"
INSTRUCTIONS = [
    line.split(maxsplit=1)
    for line in re.sub(r"\\\n", "", (FOLDER / "Dockerfile").read_text()).splitlines()
    if line and not line.startswith("#")
]


def arguments(name: str) -> list[str]:
    """Return the arguments of the only instruction of this name that is written as JSON."""
    (text,) = (text for instruction, text in INSTRUCTIONS if instruction == name)
    return json.loads(text)


def test_every_file_that_is_copied_exists_and_is_sent_to_the_builder():
    sent = [line[1:] for line in (FOLDER / "Dockerfile.dockerignore").read_text().splitlines() if line[0] == "!"]
    copied = [text.split()[-2] for instruction, text in INSTRUCTIONS if instruction == "COPY"]
    assert sorted(copied) == sorted(sent)
    wheel, entrypoint = copied
    # `make release` puts the wheel there.
    assert fnmatch.fnmatch("dist/aero_planner-0.1.0-py3-none-any.whl", wheel)
    assert (ROOT / entrypoint).stat().st_mode & 0o100 and arguments("ENTRYPOINT") == [Path(entrypoint).name]


def test_its_command_is_one_of_ours(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    command = arguments("CMD")
    assert main(command) == 2
    assert "/etc/aero/bundle.tar" in capsys.readouterr().err  # there is no bundle here, and nothing else is wrong
    guide = (ROOT / "docs" / "onboard.md").read_text(encoding="utf-8")
    assert "docker build -f planner/docker/Dockerfile" in guide and command[2] in guide


@pytest.fixture
def container(tmp_path: Path):
    """Starts the first process of a container in which the node and `sleep` are other programs."""
    processes = []

    def start(node: str) -> subprocess.Popen[str]:
        for name, script in (("aero-planner", node), ("sleep", f"echo slept $1 >>{tmp_path}/slept")):
            (tmp_path / name).write_text(f"#!/bin/bash\n{script}\n")
            (tmp_path / name).chmod(0o755)
        environment = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
        processes.append(
            subprocess.Popen([FOLDER / "entrypoint", "run"], env=environment, stdout=subprocess.PIPE, text=True)
        )
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.wait()


@pytest.mark.parametrize(("node", "code", "waits"), [
    ("exit 0", 0, False), ("exit 2", 2, False), ("kill -KILL $$", 137, True), ("exit 1", 1, True),
])  # fmt: skip
def test_the_container_outlives_a_node_that_died(container, tmp_path: Path, node: str, code: int, waits: bool):
    assert container(node).wait(60) == code
    assert (tmp_path / "slept").exists() is waits


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_the_signals_of_the_container_stop_the_node(container, tmp_path: Path, number: signal.Signals):
    process = container("trap 'echo stopped; exit 0' TERM; echo started $1; while true; do read -t 0.1 <> <(:); done")
    assert process.stdout.readline() == "started run\n"
    process.send_signal(number)
    assert process.wait(60) == 0
    assert process.stdout.read() == "stopped\n" and not (tmp_path / "slept").exists()
