"""Answers of a process that a file may have taken over."""

import array
import io
import math
import os
import pickle
import sys
from collections import Counter
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from aero_planner.onboard.failsafe_table import State
from aero_viz.answers import AnswerError, decode, encode, read_answer, write_answer
from aero_viz.catalog import load_world
from aero_viz.errors import UserError
from aero_viz.reader_process import ReaderProcess
from aero_viz.recordings.contents import Topic
from aero_viz.recordings.transforms import TransformTree


def object_array_text() -> bytes:
    """Return the text of an array whose objects NumPy would unpickle."""
    file = io.BytesIO()
    np.save(file, np.array([{}], dtype=object), allow_pickle=True)
    return file.getvalue()


def nested(depth: int) -> bytes:
    """Return the text of lists in lists."""
    return b"".join(b"\x92" + msgspec.msgpack.encode("list") for _ in range(depth)) + b"\xc0"


def read(content: bytes, limit: int = 1 << 20) -> Any:
    return read_answer(io.BytesIO(content), limit)


def written(text: bytes) -> bytes:
    file = io.BytesIO()
    write_answer(file, text)
    return file.getvalue()


class Word(str):
    """A text of another type, which is no answer."""


@pytest.mark.parametrize(
    "value",
    [
        {"a": [1, 2.5, None, b"x", {3}], (1, "b"): Path("/a"), True: frozenset({"c"})},
        [2**63, -(2**70), math.inf, 1j, range(3, 9, 2), bytearray(b"a"), array.array("d", [1.0]), Counter("aab")],
        [], (), {}, ((),), [["list", 1], ["file", 0], ["record", "aero_viz.scenes:World"]],
        State.FLYING, [Topic("/a", "b", 3), Topic("", "", 0)],
        np.float32(2.0), np.int64(3), np.datetime64("2026-11-27"),
    ],
    ids=range(12),
)  # fmt: skip
def test_values_and_records_are_answers(value: Any):
    decoded = decode(encode(value))
    assert decoded == value and repr(decoded) == repr(value)


@pytest.mark.parametrize(
    "values",
    [
        np.zeros((0, 3)), np.arange(6.0, dtype=">f4").reshape(2, 3).T, np.array(3), np.array(["a", "bc"]),
        np.array([(1, 2.0)], dtype=[("i", "<i4"), ("x", "<f8")]), np.array([["a", None], [1, (2,)]], dtype=object),
        np.zeros((0, 2), dtype=object),
    ],
    ids=range(7),
)  # fmt: skip
def test_arrays_are_answers(values: np.ndarray):
    decoded = decode(encode(values))
    np.testing.assert_array_equal(decoded, values)
    assert decoded.dtype == values.dtype and decoded.shape == values.shape and decoded.flags.writeable


def test_a_record_keeps_what_its_constructor_does_not_take():
    tree = TransformTree()
    tree.add("map", "base", 1, 2, (1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0), static=True)
    assert decode(encode(tree)) == tree


def test_open_files_stay_where_they_are():
    files = [io.BytesIO(), io.BytesIO()]
    assert decode(encode([files[1], files[0]], files), files) == files[::-1]
    with pytest.raises(AnswerError):
        decode(encode(files[1], files), files[:1])


def test_a_world_is_an_answer():
    world = load_world("forest", seed=1)
    decoded = decode(encode(world))
    np.testing.assert_array_equal(decoded.cylinders, world.cylinders)
    assert decoded.to_dict() == world.to_dict()


@pytest.mark.parametrize("value", [os.system, ReaderProcess, Word("a"), object(), [Fraction(1, 2)], io.BytesIO()])
def test_anything_else_is_no_answer(value: Any):
    with pytest.raises(TypeError, match="is no answer"):
        encode(value)


@pytest.mark.parametrize(
    "hostile",
    [
        ["record", "os:system", "touch taken_over"], ["record", "builtins:eval", "1"], ["enum", "os:system", "x"],
        ["record", "pathlib:Path", "taken_over"], ["record", "aero_viz.reader_process:ReaderProcess"],
        ["record", "aero_viz.reader_process:os.system", "touch taken_over"], ["record", "aero_viz.__main__:main"],
        ["record", "aero_viz.evaluation.machine:versions"], ["record", "aero_viz.errors:UserError", "x"],
        ["record", "aero_viz.scenes:World", 1], ["record", "aero_viz.recordings.contents:Topic", "a"],
        ["enum", "aero_planner.onboard.failsafe_table:State", "mro"],
        ["enum", "aero_viz.recordings.contents:Topic", "a"],
        ["ndarray", b"\x93NUMPY garbage"], ["ndarray", pickle.dumps(1)], ["ndarray", object_array_text()],
        ["ndarray", [2**62], 1], ["range", 1, 2, 0], ["dict", 1], ["dict", ["list"], 1], ["array", "d", b"x"],
        ["unknown"], [], [None], ["file", 0], ["list", ["unknown"]], nested(5000),
    ],
    ids=range(27),
)  # fmt: skip
def test_hostile_answers_are_refused_and_call_nothing(hostile: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AnswerError):
        decode(msgspec.msgpack.encode(hostile) if not isinstance(hostile, bytes) else hostile)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", [b"", b"garbage", b"\xc1", pickle.dumps([1])])
def test_text_that_is_no_message_is_refused(text: bytes):
    with pytest.raises(AnswerError):
        decode(text)


def test_an_answer_has_an_end_and_a_largest_size():
    content = written(encode(bytes(100_000)))
    assert read(content) == bytes(100_000)
    with pytest.raises(AnswerError, match="too large"):
        read(content, limit=50_000)
    for size in (0, 1, 20, len(content) - 1):
        with pytest.raises(EOFError):
            read(content[:size])


def test_a_process_that_was_taken_over_ends_with_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "taken.py").write_text(
        "import os\n\n\ndef over(content):\n    for number in range(3, 30):\n        try:\n"
        "            os.write(number, bytes(8) + content)\n        except OSError:\n            pass\n    os._exit(0)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path.parent)
    import taken  # type: ignore[import-not-found]

    call = msgspec.msgpack.encode(["tuple", "result", ["record", "os:mkdir", "taken_over"]])
    contents = [call, pickle.dumps(("result", 1)), encode((1, 2))]
    try:
        for content in (*map(written, contents), b"garbage and no length"):
            with pytest.raises(UserError, match="gave no proper answer"):
                ReaderProcess()(taken.over, content)
    finally:
        sys.modules.pop("taken")
    assert not (tmp_path.parent / "taken_over").exists()
