"""Malformed world files either load as a valid world, or are refused in one sentence that names the file."""

import copy
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aero_viz.errors import UserError
from aero_viz.scenes import World

VALID: dict[str, Any] = {
    "name": "w", "start": [0, 0, 2], "goal": [9, 0, 2],
    "cylinders": [[4, 3, 0, 0, 0, 1, 0.3, 4], [5, -3, 0, 0, 0, 1, 0.3, 4]],
    "boxes": [[5, 0, -0.5, 60, 60, 1, 0]], "spheres": [[3, 3, 3, 0.5]],
    "bounds": [[-20, -20, -2], [30, 20, 20]],
}  # fmt: skip

ODD = st.one_of(
    st.none(), st.booleans(), st.text(max_size=4), st.integers(), st.floats(),
    st.sampled_from([10**400, 2**63, 1e308, 1e30, 5e-324, -0.0, [], {}, [1], [[]], [None] * 8, [["a"] * 7],
                     [[1e30] * 4], [[0, 0, 0, 0, 0, 1, 1e30, 1e30]], {"a": 1}, [[[1]]]]),
)  # fmt: skip


@st.composite
def mutants(draw: st.DrawFn) -> Any:
    """Draw the valid world with one to three values replaced, removed, added or renamed, at any depth."""
    world = copy.deepcopy(VALID)
    for _ in range(draw(st.integers(1, 3))):
        node: Any = world
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(node[key], (dict, list)) and draw(st.booleans()):
                node = node[key]
                continue
            action = draw(st.sampled_from(["replace", "replace", "replace", "remove", "add"]))
            if action == "remove":
                del node[key]
            elif action == "add" and isinstance(node, list):
                node.insert(key, copy.deepcopy(draw(ODD)))
            else:
                new_key = draw(st.sampled_from(["boxs", "Start", ""])) if action == "add" else key
                node[new_key] = copy.deepcopy(draw(ODD))
            break
    return world


def check_loading(path: Path) -> None:
    """Load a file, which must give a valid world or a UserError with a short message."""
    try:
        world = World.load(path)
    except UserError as error:
        message = str(error)
        assert str(path) in message and "\n" not in message and len(message) < 400
        return
    for table in (world.start, world.goal, world.cylinders, world.boxes, world.spheres, world.bounds):
        assert np.isfinite(table).all()
    assert math.isfinite(world.distance([world.start])[0]) or not len(world.boxes) + len(world.cylinders)


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(mutants())
def test_mutants(tmp_path: Path, content: Any):
    path = tmp_path / "w.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    check_loading(path)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_text(tmp_path: Path, data: st.DataObject):
    text = bytearray(json.dumps(VALID).encode())
    for _ in range(data.draw(st.integers(1, 4))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "w.json"
    path.write_bytes(bytes(text[: data.draw(st.integers(0, len(text)))]))
    check_loading(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spheres": [[0, 0, 0, 1e6]]}, '"spheres" row 0 has radius = 1e+06; it must be greater than 0 and at most'),
        ({"boxes": [[0, 2e5, 0, 1, 1, 1, 0]]}, '"boxes" row 0 has cy = 200000; it must be within 100000 m'),
        ({"cylinders": [[0, 0, 0, 0, 0, 1e300, 1, 1]]}, '"cylinders" row 0 has an axis of length inf'),
        ({"cylinders": "x" * 5000}, "\"cylinders\" is 'xxxxxxxxxxxx...xxxxxxxxxxxxx'"),
        ({"goal": [[1, 2, 3], 4, 5]}, '"goal" has x = [1, 2, 3]; it must be a finite number'),
        ({"goals": [0, 0, 0]}, "unknown key 'goals' (did you mean 'goal'?)"),
    ],
)
def test_errors_are_precise_and_short(tmp_path: Path, changes: dict[str, Any], message: str):
    path = tmp_path / "w.json"
    path.write_text(json.dumps(VALID | changes), encoding="utf-8")
    with pytest.raises(UserError) as caught:
        World.load(path)
    assert message in str(caught.value)


def test_a_folder_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="Is a directory"):
        World.load(tmp_path)


def test_a_pipe_and_a_file_of_gigabytes_are_refused(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(UserError, match=r"pipe\.json: it is a pipe, not a regular file"):
        World.load(tmp_path / "pipe.json")
    with (tmp_path / "large.json").open("wb") as file:
        file.truncate(8 << 30)
    with pytest.raises(UserError, match=r"large\.json: it is larger than 64 MiB"):
        World.load(tmp_path / "large.json")
