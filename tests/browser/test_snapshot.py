"""Headless pictures: their content, and that they are repeatable."""

import json
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from small_source import small_source

from aero_planner import PlannerConfig
from aero_viz.cli import main
from aero_viz.dashboard import palette
from aero_viz.dashboard.snapshot import snapshot
from aero_viz.errors import UserError
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from tests.browser.pictures import count

# Written by running this file.
REFERENCE = Path(__file__).with_name("snapshot_reference.json")
ARGUMENTS: dict[str, Any] = {"time": 1.0, "config": PlannerConfig.preset("paper"), "size": (640, 400)}
COLORS = {name: getattr(palette, name) for name in ("GUIDE", "ANCHOR", "DRONE")}


def structure(image: np.ndarray) -> dict[str, int]:
    """Count the pixels in the colour of each layer, and those brighter than the background."""
    counts = {name: int((np.abs(image.astype(int) - color).max(axis=-1) <= 24).sum()) for name, color in COLORS.items()}
    return counts | {"bright": int((image.max(axis=-1) > 90).sum())}


def test_a_picture_shows_every_layer_and_is_repeatable(browser, tmp_path):
    del browser  # skips where there is none
    first = snapshot(FlightSource(scene("forest", seed=0)), path=tmp_path / "a.png", **ARGUMENTS)
    assert first.shape == (400, 640, 3)
    assert (tmp_path / "a.png").stat().st_size > 10_000
    expected = json.loads(REFERENCE.read_text())
    assert structure(first) == pytest.approx(expected, rel=0.4, abs=40)
    second = snapshot(FlightSource(scene("forest", seed=0)), **ARGUMENTS)
    assert (np.abs(first.astype(int) - second).max(axis=-1) > 8).mean() < 0.002


def test_a_picture_from_the_command_line_has_the_layers_the_camera_and_the_legend_asked_for(browser, tmp_path):
    del browser
    path = tmp_path / "a.png"
    camera = "--camera=-6,0,4,2,0,2"
    options = ["--layers", "guides", "--legend", "--size", "640", "400"]
    main(["snapshot", "forest", str(path), "--time", "0.2", camera, *options])
    image = iio.imread(path)
    corner = image[330:390, 20:280]
    assert structure(image[:300])["GUIDE"] > 100 and structure(image)["ANCHOR"] == 0
    assert structure(corner)["GUIDE"] > 10 and (corner.max(axis=-1) < 60).mean() > 0.5


def test_a_light_picture_is_for_paper(browser, tmp_path):
    del browser
    path = tmp_path / "a.png"
    layers = ["--layers", "rollouts,guides,trail,ground", "--legend", "--light"]
    main(["snapshot", "forest", str(path), "--time", "0.6", *layers, "--size", "640", "400"])
    image = iio.imread(path)
    assert np.median(image[:40]) > 250 and np.median(image[350:380, 40:200]) > 235
    for color in (palette.CHOSEN, palette.GUIDE, palette.DRONE):
        assert count(image, palette.turned_over([color])[0], tolerance=40) > 60
    assert count(image, palette.CHOSEN) == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full needs Linux")
def test_a_full_disk_is_named(browser, tmp_path):
    del browser
    (tmp_path / "a.png").symlink_to("/dev/full")
    with pytest.raises(UserError, match=r"a\.png cannot be written: No space left on device\.$"):
        snapshot(small_source(), path=tmp_path / "a.png", size=(160, 100))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"layers": ["clouds"]}, "no layer 'clouds'"),
        ({"camera": "front"}, "Unknown camera 'front'"),
        ({"camera": ((0, 0, 0), (0, 0, 0))}, "two different points"),
        ({"time": -1.0}, "not negative"),
        ({"size": (0, 400)}, "0 x 400 pixels"),
        ({"path": "no/such/folder/a.png"}, "there is no folder no/such/folder"),
        ({"path": "/"}, "it is a folder; give the name of a file, such as /picture.png"),
        ({"path": "forest.txt"}, "pictures are PNG files; name it forest.png"),
    ],
)
def test_mistakes_are_reported_before_a_browser_starts(arguments, words):
    with pytest.raises(UserError, match=words):
        snapshot(small_source(), **arguments)


if __name__ == "__main__":
    picture = snapshot(FlightSource(scene("forest", seed=0)), **ARGUMENTS)
    REFERENCE.write_text(json.dumps(structure(picture), indent=2) + "\n")
