"""Answers of a process that a file may have taken over."""

import dataclasses
import io
import os
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aero_viz.answers import decode, encode
from aero_viz.catalog import load_world
from aero_viz.errors import UserError
from aero_viz.evaluation.machine import versions
from aero_viz.reader_process import ReaderProcess


class Calls:
    """Calls a function when it is decoded."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> Any:
        return self._call


def read(content: bytes, limit: int = 1 << 20) -> Any:
    return decode(io.BytesIO(content), limit)


def test_values_arrays_and_records_are_answers():
    world = load_world("forest", seed=1)
    values = {"a": [1, 2.5, None, b"x", {3}], "path": Path("/a"), "scalar": np.float32(2.0), "range": range(3)}
    table = np.array([(1, 2.0)], dtype=[("i", "<i4"), ("x", "<f8")])
    decoded = read(encode((values, world, table, np.zeros((0, 3)), np.array(["a", None], dtype=object))))
    assert decoded[0] == values and dataclasses.is_dataclass(decoded[1])
    np.testing.assert_array_equal(decoded[1].cylinders, world.cylinders)
    np.testing.assert_array_equal(decoded[2], table)


@pytest.mark.parametrize(
    "hostile",
    [
        Calls(os.system, "touch taken_over"), Calls(eval, "1"), Calls(getattr, Path, "unlink"),
        Calls(open, "taken_over", "w"),
        Calls(ReaderProcess), Calls(versions), Calls(UserError, "x"), os.system, ReaderProcess, versions,
        Calls(np.load, "x"), Calls(Path.touch, Path("taken_over")),
    ],
    ids=range(12),
)  # fmt: skip
def test_nothing_is_called(hostile: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for content in (pickle.dumps(hostile), pickle.dumps(("result", [hostile]), protocol=0)):
        with pytest.raises(pickle.UnpicklingError):
            read(content)
    assert not list(tmp_path.iterdir())


def test_an_answer_has_an_end_and_a_largest_size():
    content = encode(bytes(100_000))
    assert read(content) == bytes(100_000)
    with pytest.raises(pickle.UnpicklingError, match="too large"):
        read(content, limit=50_000)
    for size in (0, 1, 20, len(content) - 1):
        with pytest.raises(EOFError):
            read(content[:size])


def test_a_process_that_was_taken_over_ends_with_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "taken.py").write_text(
        "import os, pickle\n\n\nclass Calls:\n    def __reduce__(self):\n        return os.mkdir, ('taken_over',)\n\n\n"
        "def over(content=None):\n    content = pickle.dumps(('result', Calls())) if content is None else content\n"
        "    for number in range(3, 30):\n        try:\n            os.write(number, bytes(8) + content)\n"
        "        except OSError:\n            pass\n    os._exit(0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path.parent)
    import taken  # type: ignore[import-not-found]

    try:
        for content in (None, b"garbage", b"\x80\x05K\x01."):
            with pytest.raises(UserError, match=r"gave no proper answer|ended with code"):
                ReaderProcess()(taken.over, content)
    finally:
        sys.modules.pop("taken")
    assert not (tmp_path.parent / "taken_over").exists()
