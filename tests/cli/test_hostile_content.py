"""Files whose content or name is meant for the terminal, numbers beyond all bounds, and a disk that is full."""

import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command_line import run, run_refused

from aero_viz.scenes import World
from tests import bags

ESCAPES = "\x1b]0;HACKED\x07\x1b[31m"
COMMAND = [sys.executable, "-m", "aero_viz"]


def is_plain(text: str) -> bool:
    return all(letter.isprintable() or letter == "\n" for letter in text)


@pytest.mark.parametrize(
    "name", [f"a{ESCAPES}.json", "a\udcff\udcfe.json", "a\r\u202eb.json"], ids=["escapes", "no UTF-8", "direction"]
)
def test_a_name_does_not_control_the_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str):
    assert is_plain(run_refused(capsys, "world", "info", str(tmp_path / name)))
    path = tmp_path / name
    path.write_text(f'{{"name": "{chr(27)}", "x": 1}}')
    assert is_plain(run_refused(capsys, "world", "info", str(path)))
    World("w", np.array([0.0, 0.0, 2.0]), np.array([3.0, 0.0, 2.0])).save(path)
    for command in (("world", "info"), ("inspect",), ("compare", str(path))):
        _, shown, error = run(capsys, *command, str(path))
        assert is_plain(shown) and is_plain(error)


def test_the_content_does_not_control_the_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path):
    (tmp_path / "old.bag").write_bytes(f"#ROSBAG V1.2{ESCAPES}".encode())
    assert is_plain(run_refused(capsys, "inspect", str(tmp_path / "old.bag")))
    (tmp_path / "key.json").write_text(f'{{"\\u001b[31m": 1, "{ESCAPES}": 2}}')
    assert is_plain(run_refused(capsys, "world", "info", str(tmp_path / "key.json")))
    (tmp_path / "config.yaml").write_text('costs:\n  "q\\e[31m": 3\n')
    assert is_plain(run_refused(capsys, "fly", "forest", "--config", str(tmp_path / "config.yaml")))
    items = [bags.text(0.1 * i, topic=f"/n{ESCAPES}") for i in range(3)]
    bags.write_mcap(tmp_path / "topics.mcap", [*bags.drive(3), *items])
    code, shown, error = run(capsys, "inspect", str(tmp_path / "topics.mcap"))
    assert code == 0 and is_plain(shown) and is_plain(error)


@pytest.mark.parametrize("number", ["1e305", "-1e300", "1e39"])
def test_a_mesh_with_huge_coordinates_is_refused_by_name(capsys, tmp_path: Path, number: str, recwarn):
    rows = [("0 0 0", "1 0 0", "0 1 0"), ("0 0 1", f"1 0 {number}", "0 1 1"), ("-1e307 0 0", "1 1 0", "0 1 0")]
    facets = ("".join(f"vertex {corner}\n" for corner in row) for row in rows)
    text = "".join(f"facet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\n" for corners in facets)
    (tmp_path / "x.stl").write_text(f"solid\n{text}endsolid\n")
    error = run_refused(capsys, "world", "info", str(tmp_path / "x.stl"))
    assert "x.stl spans" in error and "crop it" in error and not recwarn.list


SIZE = "<geometry><box><size>1 x 3</size></box></geometry>"
MALFORMED = {
    "deep.json": "[" * 300_000,
    "digits.json": '{"name": "a", "start": [' + "9" * 5000 + "]}",
    "a.xyz": "1 2 x\n3 4 5\n",
    "a.pts": "x\n1 2 3\n",
    "a.obj": "v 1 2\nf 1 2 3\n",
    "a.off": "OFF\n1 a 0\n1 2 3\n",
    "a.stl": "solid\nvertex a\n",
    "a.pcd": "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS x\nDATA ascii\n",
    "a.ply": "ply\nend_header\n",
    "a.world": f"<sdf><world><model><link><collision>{SIZE}</collision></link></model></world></sdf>",
    "a.npy": "\x93NUMPY",
    "a.glb": "glTF",
    "a.yaml": "image: a.png\nresolution: x\n",
    "no_text.yaml": "\xff\xfe\x95",
    "a.png": "\x89PNG",
    "a.pgm": "",
    "cut.pgm": "P5 9 9 255\n1",
    "cut.png": "\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0",
    "a.las": "LASF",
    "a.e57": "ASTM-E57",
}


@pytest.mark.parametrize("name", MALFORMED)
def test_no_error_is_in_the_words_of_python(capsys, tmp_path: Path, name: str):
    (tmp_path / name).write_text(MALFORMED[name], encoding="latin-1")
    error = run_refused(capsys, "world", "info", str(tmp_path / name))
    assert name in error and error.count("\n") == 1
    python = ("sys.", "index", "convert", "codec", "literal", "Error", "dimension", "unpack", "object", "<", "identify")
    for words in python:
        assert words not in error, error


@pytest.fixture
def full_disk() -> Iterator[Callable[[], None]]:
    """A function after whose call no file grows beyond 20 kB."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("name", ["out.ply", "out.pcd", "out.npy", "out.json"])
def test_a_full_disk_leaves_no_half_world(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, full_disk: Callable[[], None], name: str
):
    boxes = np.full((400, 7), 0.3)
    boxes[:, :3] = np.random.default_rng(0).uniform(1.0, 9.0, (400, 3))
    world, output = str(tmp_path / "world.json"), tmp_path / name
    World("w", np.array([0.0, 0.0, 20.0]), np.array([3.0, 0.0, 20.0]), boxes=boxes).save(world)
    assert run(capsys, "world", "export", world, str(output))[0] == 0 and output.stat().st_size > 20_000
    output.write_text("old")
    full_disk()
    assert name in run_refused(capsys, "world", "export", world, str(output), "--overwrite")
    assert output.read_text() == "old" and sorted(os.listdir(tmp_path)) == sorted(["world.json", name])


def test_two_flights_do_not_write_one_log(poles: str, tmp_path: Path):
    flags = ["--sampling.samples", "16", "--lidar.points-per-sweep", "1000", "--log", str(tmp_path / "flight.mcap")]
    started = [
        subprocess.Popen([*COMMAND, "fly", poles, *flags], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    errors = [process.communicate(timeout=300.0)[1] for process in started]
    assert sorted(process.returncode for process in started) == [0, 2]
    assert any("flight.mcap: another program is writing it" in error or "exists already" in error for error in errors)
