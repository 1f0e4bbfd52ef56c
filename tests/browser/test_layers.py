"""Each layer draws what it should, where it should, and nothing when it is off."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers.rollouts import cost_scale
from aero_viz.dashboard.panels.camera import FIELD_OF_VIEW

# Layer, one of its colours, pixels of that colour that must be there. Shaded surfaces are asked for any pixel.
DRAWN = [
    ("rollouts", palette.CHOSEN, 60),
    ("samples", None, 400),
    ("guides", palette.GUIDE, 60),
    ("anchors", palette.ANCHOR, 60),
    ("cloud", None, 1000),
    ("fine_cells", None, 1000),
    ("coarse_cells", palette.GRID_SECTION, 100),
    ("drone", None, 60),
    ("trail", palette.TRAIL, 20),
    ("obstacles", None, 3000),
    ("ground", None, 5000),
]


def count(image: NDArray[np.uint8], color: palette.Rgb, *, tolerance: int = 24) -> int:
    """Opaque pixels near `color`."""
    away = np.abs(image[..., :3].astype(int) - color).max(axis=-1)
    return int(((away <= tolerance) & (image[..., 3] > 128)).sum())


def behind(desk) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    position = np.asarray(desk.session.frame.observation.state.position)
    return np.add(position, (-3.0, -1.0, 2.5)), np.add(position, (1.5, 0.0, 0.0))


@pytest.mark.parametrize(("name", "color", "least"), DRAWN, ids=[name for name, _, _ in DRAWN])
def test_a_layer_is_there_when_on_and_gone_when_off(desk, name, color, least):
    desk.session.set_samples(name == "samples").result()
    desk.dashboard.show_only([name])
    image = desk.render(*behind(desk))
    drawn = int((image[..., 3] > 128).sum()) if color is None else count(image, color)
    assert drawn >= least
    desk.dashboard.show_only([])
    assert (desk.render(*behind(desk))[..., 3] == 0).all()


def test_the_goal_is_drawn_at_the_goal(desk):
    goal = np.asarray(desk.session.frame.observation.goal.position)
    desk.dashboard.show_only(["goal"])
    image = desk.render(np.add(goal, (-5.0, 0.0, 0.5)), goal)
    assert image[300, 320, 0] > 100, "red at the middle of the picture"
    assert count(image, palette.GOAL) > 50


def test_all_fifteen_rollouts_are_on_screen_each_in_its_colour(desk):
    plan = desk.session.frame.plan
    assert len(plan.positions) == 15
    desk.dashboard.show_only(["rollouts"])
    position, look_at = behind(desk)
    image = desk.render(position, look_at)
    expected = palette.colorize(cost_scale(plan), 0.0, 1.0, palette.COST).astype(int)
    expected[plan.best] = palette.CHOSEN
    found = [
        _share(image, _project(plan.positions[i, 4:], position, look_at, image.shape), expected[i]) for i in range(15)
    ]
    assert min(found) > 0.2, f"share of each rollout's vertices that have its colour: {np.round(found, 2)}"
    assert len({tuple(color) for color in expected}) == 15


def _project(points, position, look_at, shape) -> NDArray[np.int64]:
    """Pixel (row, column) of world points, for a pinhole camera with z up in the picture."""
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    local = (points - position) @ np.stack((right, np.cross(forward, right), forward), axis=1)
    focal = 0.5 * shape[0] / np.tan(0.5 * FIELD_OF_VIEW)
    pixel = focal * local[:, :2] / local[:, 2:] + (0.5 * shape[1], 0.5 * shape[0])
    return pixel[:, ::-1].round().astype(int)


def _share(image, pixels, color) -> float:
    """Share of the pixels with `color` within a step around."""
    height, width = image.shape[:2]
    inside = pixels[(pixels > 1).all(axis=1) & (pixels[:, 0] < height - 2) & (pixels[:, 1] < width - 2)]
    hits = [
        np.abs(image[r - 1 : r + 2, c - 1 : c + 2, :3].astype(int) - color).max(axis=-1).min() <= 22 for r, c in inside
    ]
    return float(np.mean(hits)) if len(hits) else 0.0
