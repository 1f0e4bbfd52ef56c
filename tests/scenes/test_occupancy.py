"""Occupancy images in the layout of kr_param_map's mazes and of ROS's map server."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from aero_viz.errors import UserError
from aero_viz.scenes import World, load_map

ENDS: dict[str, Any] = {"start": (1.0, 1.0, 1.5), "goal": (5.0, 3.0, 1.5)}


def maze(path: Path, *, mode: str = "RGB") -> Path:
    """Write an image of 60 x 40 pixels with a wall at the left and a block in the upper right corner."""
    pixels = np.full((40, 60), 255, np.uint8)
    pixels[:, :2] = 0
    pixels[:10, 50:] = 0
    Image.fromarray(pixels).convert(mode).save(path)
    return path


def walls(world: World) -> np.ndarray:
    """Return the boxes without ceiling and floor, in order."""
    boxes = world.boxes[world.boxes[:, 5] == 3.0]
    return boxes[np.lexsort(boxes[:, :2].T[::-1])]


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
def test_dark_pixels_are_walls_between_floor_and_ceiling(tmp_path: Path, mode: str):
    world = load_map(maze(tmp_path / "maze.png", mode=mode), **ENDS)
    np.testing.assert_allclose(walls(world)[:, :6], [[0.1, 2.0, 1.5, 0.2, 4.0, 3.0], [5.5, 3.5, 1.5, 1.0, 1.0, 3.0]])
    assert world.ground_height == 0.0
    np.testing.assert_allclose(world.distance([[2.0, 2.0, 1.4], [2.0, 2.0, 1.7]]), [1.4, 1.3])


def test_the_file_of_the_map_server_places_and_scales_the_image(tmp_path: Path):
    maze(tmp_path / "maze.pgm", mode="L")
    text = "image: maze.pgm\nresolution: 0.2\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
    (tmp_path / "maze.yaml").write_text(text, encoding="utf-8")
    ends: dict[str, Any] = {"start": (1.0, 0.0, 1.5), "goal": (5.0, 1.0, 1.5)}
    by_yaml, by_image = (load_map(tmp_path / name, **ends) for name in ("maze.yaml", "maze.pgm"))
    np.testing.assert_allclose(walls(by_yaml)[0, :6], [-0.8, 2.0, 1.5, 0.4, 8.0, 3.0])
    np.testing.assert_array_equal(by_yaml.boxes, by_image.boxes)


def test_a_negated_image_has_white_walls(tmp_path: Path):
    maze(tmp_path / "maze.png")
    (tmp_path / "maze.yaml").write_text("image: maze.png\nnegate: 1\n", encoding="utf-8")
    world = load_map(tmp_path / "maze.yaml", start=(5.5, 3.5, 1.5), goal=(5.2, 3.2, 1.5))
    assert world.distance([[5.5, 3.5, 1.5]])[0] > 0.0
    assert world.distance([[2.0, 2.0, 1.5]])[0] < 0.0


def test_the_pixel_size_can_be_given(tmp_path: Path):
    world = load_map(maze(tmp_path / "maze.png"), voxel=0.5, start=(5.0, 5.0, 1.5), goal=(20.0, 5.0, 1.5))
    np.testing.assert_allclose(walls(world)[0, :6], [0.5, 10.0, 1.5, 1.0, 20.0, 3.0])


def test_start_and_goal_are_found(tmp_path: Path):
    world = load_map(maze(tmp_path / "maze.png"), across=True)
    assert world.start[0] < 2.0
    assert world.goal[0] > 4.0


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        ("image: maze.png\nresolution: 0\n", "resolution is 0 m per pixel"),
        ("image: maze.png\norigin: [0, 0, 1.5]\n", "turned by 1.5 rad"),
        ("image: maze.png\norigin: far\n", "origin three of them"),
        ("image: /etc/passwd\n", "must be a PNG or PGM file"),
        ("- 1\n", "the key image"),
        ("{", "is not YAML"),
        ("image: none.png\n", "no such file"),
        ("image: /dev/zero\n", "must be a PNG or PGM file"),
        ("image: ../maze.png\n", "only files of its own folder"),
        ("image: below/../../maze.png\n", "only files of its own folder"),
        ("image: /etc/passwd.png\n", "only files of its own folder"),
        ("image: leading_out.png\n", "only files of its own folder"),
        ("image: zero.png\n", "only files of its own folder"),
        ("image: pipe.png\n", "it is a pipe, not a regular file"),
        ("image: folder.png\n", "is a directory"),
        ("image: maze.png\nresolution: [[1]]\n", "the value of resolution must be"),
        (f"image: maze.png\nresolution: {'9' * 5000}\n", "the value of resolution must be"),
        ("image: maze.png\nresolution: !!python/name:os.system\n", "the value of resolution is not understood"),
        ("image: maze.png\norigin: " + "[" * 100 + "]" * 100, "nested more than 20 deep"),
    ],
)
def test_a_damaged_file_of_the_map_server_is_explained(tmp_path: Path, yaml: str, message: str):
    home = tmp_path / "home"
    (home / "below").mkdir(parents=True)
    (home / "folder.png").mkdir()
    for folder in (tmp_path, home):
        maze(folder / "maze.png")
    os.mkfifo(home / "pipe.png")
    (home / "leading_out.png").symlink_to("../maze.png")
    (home / "zero.png").symlink_to("/dev/zero")
    (home / "map.yaml").write_text(yaml, encoding="utf-8")
    with pytest.raises(UserError, match=f"(?i){message}"):
        load_map(home / "map.yaml", **ENDS)


@pytest.mark.parametrize("merge", [True, False], ids=["merge keys", "aliases"])
def test_a_text_that_expands_without_end_costs_nothing(tmp_path: Path, merge: bool):
    maze(tmp_path / "maze.png")
    lines = ["a: &k0 {x: 1}" if merge else "a: &k0 [1]"]
    for i in range(30):
        several = ", ".join([f"*k{i}"] * 12)
        lines.append(f"b{i}: &k{i + 1} " + (f"{{<<: [{several}]}}" if merge else f"[{several}]"))
    (tmp_path / "map.yaml").write_text("\n".join([*lines, "image: maze.png", "resolution: 0.5"]), encoding="utf-8")
    world = load_map(tmp_path / "map.yaml", start=(5.0, 5.0, 1.5), goal=(20.0, 5.0, 1.5))
    np.testing.assert_allclose(walls(world)[0, :6], [0.5, 10.0, 1.5, 1.0, 20.0, 3.0])


def test_what_is_no_image_is_refused(tmp_path: Path):
    (tmp_path / "x.png").write_bytes(b"not an image")
    with pytest.raises(UserError, match=r"Cannot read the world .*x\.png"):
        load_map(tmp_path / "x.png")
