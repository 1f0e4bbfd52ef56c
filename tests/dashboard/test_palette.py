"""Colormaps, and colours after the film curve of the page."""

import numpy as np
import pytest

from aero_viz.dashboard import palette

LINES = {
    name: getattr(palette, name) for name in ("CHOSEN", "GUIDE", "ANCHOR", "ENDPOINT", "TRAIL", "GOAL", "RECORDED")
}


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


def test_layers_differ_in_colour():
    colors = np.array(list(LINES.values()), dtype=float)
    apart = np.abs(colors[:, None] - colors[None]).max(axis=-1)
    assert apart[~np.eye(len(colors), dtype=bool)].min() > 35


def test_cells_that_were_not_measured_differ_in_colour_from_each_other_and_from_measured_ones():
    cells = np.array([palette.CONTINUED, palette.UNSEEN, palette.OCCLUDED], dtype=float)
    apart = np.abs(cells[:, None] - cells[None]).max(axis=-1)
    assert apart[~np.eye(3, dtype=bool)].min() > 90
    assert np.abs(palette.NEAR_TO_FAR.astype(float) - palette.CONTINUED).max(axis=-1).min() > 90


@pytest.mark.parametrize("table", [palette.VIRIDIS, palette.PLASMA], ids=["viridis", "plasma"])
def test_sequential_maps_rise_in_lightness(table):
    lightness = table @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) > -1.0).all()
    assert lightness[-1] - lightness[0] > 150


def test_colorize_runs_from_the_first_to_the_last_row():
    table = np.arange(30, dtype=np.uint8).reshape(10, 3)
    np.testing.assert_array_equal(palette.colorize([-5.0, 0.0, 9.0, 99.0], 0.0, 9.0, table), table[[0, 0, 9, 9]])
