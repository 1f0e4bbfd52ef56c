"""What a reading process can no longer do, once a file has taken it over."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.reader_process import ReaderProcess

landlockpy = pytest.importorskip("landlockpy", reason="Landlock is there on Linux only")
pytestmark = pytest.mark.skipif(not landlockpy.supported(), reason="this kernel has no Landlock: limits only")


def connect(port: int) -> None:
    socket.create_connection(("127.0.0.1", port), timeout=5.0).close()


def listen() -> None:
    socket.create_server(("127.0.0.1", 0)).close()


def write(path: str) -> None:
    Path(path).write_text("x")


def read(path: str) -> str:
    return Path(path).read_text()


def end(process: int) -> None:
    os.kill(process, signal.SIGTERM)


def pass_on(function: Callable[..., object], argument: object) -> object:
    """Do something in a process that the reader starts."""
    return ReaderProcess()(function, argument)


def load(path: str) -> float:
    """Use the libraries that decode files, and the temporary folder."""
    import laspy  # noqa: F401
    import trimesh  # noqa: F401

    with tempfile.TemporaryFile() as file:
        file.write(Path(path).read_bytes())
        file.seek(0)
        return float(np.load(file).sum())


@pytest.fixture
def home() -> Iterator[Path]:
    """A folder outside of the temporary one, as somebody's own files have."""
    with tempfile.TemporaryDirectory(dir="/var/tmp") as name:
        (Path(name) / "secret").write_text("secret")
        np.save(Path(name) / "array.npy", np.ones(9))
        yield Path(name)


def refuse(reader: ReaderProcess, function: Callable[..., object], *arguments: object) -> None:
    with pytest.raises(UserError, match=r"[Pp]ermi"):
        reader(function, *arguments)


def test_a_reader_writes_nothing_and_reaches_no_network(home: Path):
    with (
        contextlib.closing(ReaderProcess(is_kept=True)) as reader,
        socket.create_server(("127.0.0.1", 0)) as server,
    ):
        assert reader(load, str(home / "array.npy")) == 9.0
        refuse(reader, write, str(home / "new"))
        refuse(reader, write, str(home / "secret"))
        refuse(reader, listen)
        refuse(reader, connect, server.getsockname()[1])
    refuse(ReaderProcess(), pass_on, write, str(home / "secret"))
    assert (home / "secret").read_text() == "secret" and not (home / "new").exists()


def test_a_reader_sends_no_signals_to_other_processes():
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as other:
        refuse(ReaderProcess(), end, other.pid)
        other.communicate(b"\n")
    assert other.returncode == 0


def test_a_reader_of_the_page_reads_in_its_folders_only(home: Path, tmp_path: Path):
    assert ReaderProcess(folders=[home])(load, str(home / "array.npy")) == 9.0
    refuse(ReaderProcess(folders=[tmp_path]), read, str(home / "secret"))
