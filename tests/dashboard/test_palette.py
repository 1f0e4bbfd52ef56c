"""Colormaps, and colours after the film curve of the page."""

from collections.abc import Sequence

import numpy as np
import pytest

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import LAYERS

LINES = {
    name: getattr(palette, name)
    for name in (
        "CHOSEN", "GUIDE", "ANCHOR", "ENDPOINT", "DRONE", "GOAL", "RECORDED", "GHOST", "SELECTED", "MOVING",
    )
}  # fmt: skip
MEANT = np.array(list(palette.MEANINGS))
STATES = (palette.GOOD, palette.WARNING, palette.BAD)
SCALES = {"COST": palette.COST, "HEIGHT": palette.HEIGHT, "NEAR_TO_FAR": palette.NEAR_TO_FAR}
# What readers with a red-green deficiency see of linear light, after Machado, Oliveira and Fernandes, 2009.
DEFICIENCIES = {
    "none": np.eye(3),
    "deutan": np.array([[0.3673, 0.8606, -0.2280], [0.2801, 0.6725, 0.0474], [-0.0118, 0.0429, 0.9689]]),
    "protan": np.array([[0.1523, 1.0526, -0.2049], [0.1145, 0.7863, 0.0992], [-0.0039, -0.0481, 1.0520]]),
}  # fmt: skip


def perceived(colors: np.ndarray, deficiency: str = "none") -> np.ndarray:
    """Return colours in 100 times Oklab, after Ottosson, in which 2 can hardly be told apart."""
    shown = np.asarray(colors, dtype=float) / 255.0
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ DEFICIENCIES[deficiency].T, 0.0, 1.0)
    cones = [
        (0.41222147, 0.53633254, 0.05144599),
        (0.2119035, 0.68069955, 0.10739696),
        (0.08830246, 0.28171884, 0.6299787),
    ]
    axes = [
        (0.21045426, 0.7936178, -0.00407205),
        (1.9779985, -2.4285922, 0.45059371),
        (0.02590404, 0.78277177, -0.80867577),
    ]
    return 100.0 * np.cbrt(seen @ np.array(cones).T) @ np.array(axes).T  # fmt: skip


def apart(colors: np.ndarray, others: np.ndarray, deficiency: str = "none") -> np.ndarray:
    """Return the distance of each colour from the nearest of the others."""
    difference = perceived(colors, deficiency)[:, None] - perceived(others, deficiency)[None]
    return np.linalg.norm(difference, axis=-1).min(axis=1)


ACES_IN = np.array([[0.59719, 0.35458, 0.04823], [0.076, 0.90834, 0.01566], [0.0284, 0.13383, 0.83777]])
ACES_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])


def film(linear: np.ndarray) -> np.ndarray:
    """Return the colour that three.js shows for linear light: ACES filmic as published by Stephen Hill, then sRGB."""
    light = linear / 0.6 @ ACES_IN.T
    curved = (light * (light + 0.0245786) - 0.000090537) / (light * (0.983729 * light + 0.432951) + 0.238081)
    shown = np.clip(curved @ ACES_OUT.T, 0.0, 1.0)
    return 255.0 * np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1.0 / 2.4) - 0.055)


@pytest.mark.parametrize("color", LINES.values(), ids=LINES.keys())
def test_line_colours_survive_the_film_curve(color):
    sent = palette.unmapped(np.array([color])) / 255.0
    np.testing.assert_allclose(film(sent)[0], color, atol=10.0)


def test_the_cost_colormap_survives_the_film_curve():
    np.testing.assert_allclose(film(palette.unmapped(palette.COST) / 255.0), palette.COST, atol=22.0)


def all_apart(colors: np.ndarray, meanings: Sequence[str], deficiency: str, least: float) -> None:
    for row, meaning in enumerate(meanings):
        distances = apart(np.delete(colors, row, axis=0), colors[row : row + 1], deficiency)
        nearest = [*meanings[:row], *meanings[row + 1 :]][int(distances.argmin())]
        assert distances.min() >= least, f"{meaning} and {nearest}: {distances.min():.1f}"


@pytest.mark.parametrize(("deficiency", "least"), [("none", 9.5), ("deutan", 6.0), ("protan", 6.0)])
def test_no_colour_has_two_meanings(deficiency, least):
    meanings = list(palette.MEANINGS.values())
    assert len(set(meanings)) == len(MEANT)
    all_apart(MEANT, meanings, deficiency, least)


@pytest.mark.parametrize(("deficiency", "least"), [("none", 7.0), ("deutan", 4.5), ("protan", 4.5)])
def test_nor_has_one_in_the_light_scene(deficiency, least):
    of_scene = {color: meaning for color, meaning in palette.MEANINGS.items() if color not in STATES}
    light = palette.turned_over(np.array(list(of_scene)))
    all_apart(light, list(of_scene.values()), deficiency, least)
    all_apart(np.vstack((light, [(255, 255, 255)])), [*of_scene.values(), "paper"], "none", 7.0)


def test_what_a_scale_shows_is_taken_for_nothing_else():
    # Surfaces have shades, and the state of a flight is told by words beside its colour.
    marks = np.array([color for color in palette.MEANINGS if color not in (palette.OBSTACLE, *STATES)])
    for name, scale in SCALES.items():
        assert apart(marks, scale).min() > 6.5, name
        assert apart(palette.turned_over(marks), palette.turned_over(scale)).min() > 4.0, name
        for other, others in SCALES.items():
            assert other == name or apart(scale, others).min() > 5.0, (name, other)


def test_every_layer_explains_its_colours_by_one_meaning():
    explained: dict[str, str] = {}
    for name in LAYERS.shipped:
        for key in LAYERS[name].keys:
            is_ground = key.color == palette.GRID_SECTION
            assert is_ground or key.color in palette.MEANINGS, f"{key.label} has a colour without a meaning"
            explained[key.label] = palette.MEANINGS.get(key.color, "the ground")
    assert len(set(explained.values())) >= 9


@pytest.mark.parametrize("deficiency", DEFICIENCIES)
@pytest.mark.parametrize("name", SCALES)
def test_scales_rise_or_fall_in_lightness_for_everyone(name, deficiency):
    lightness = perceived(SCALES[name], deficiency)[:, 0]
    steps = np.diff(lightness) * np.sign(lightness[-1] - lightness[0])
    assert steps.min() > -0.6 and abs(lightness[-1] - lightness[0]) > 12.0


def test_the_light_scene_keeps_hues_and_turns_lightness_over():
    dark = np.concatenate((MEANT, palette.COST[::20]))
    before, after = perceived(dark), perceived(palette.turned_over(dark))
    assert np.corrcoef(before[:, 0], after[:, 0])[0, 1] < -0.9
    colored = np.hypot(*before[:, 1:].T) > 8.0
    hues = [np.arctan2(lab[colored, 2], lab[colored, 1]) for lab in (before, after)]
    turned = np.degrees(np.abs((hues[1] - hues[0] + np.pi) % (2.0 * np.pi) - np.pi))
    assert np.median(turned) < 25.0
    np.testing.assert_array_equal(palette.turned_over([(0, 0, 0)]), [(255, 255, 255)])
    assert palette.turned_over([(255, 255, 255)]).max() < 60


def test_colorize_runs_from_the_first_to_the_last_row():
    table = np.arange(30, dtype=np.uint8).reshape(10, 3)
    np.testing.assert_array_equal(palette.colorize([-5.0, 0.0, 9.0, 99.0], 0.0, 9.0, table), table[[0, 0, 9, 9]])
