"""Background, fog and lights of the scene, dark or light."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray

from aero_viz.dashboard import palette


def style_scene(scene: viser.SceneApi, *, light: bool = False) -> None:
    """Give the scene of all visitors, or of one, its background, fog and lights.

    The light scene is drawn dark and then turned over, by `palette.TURNED_OVER` or `palette.turned_over`. It is
    therefore lit from below here, and its background is black: it becomes white paper, with the sun above it.
    """
    scene.set_background_image(sky(256, 4, light=light), format="png")
    scene.configure_fog(14.0, 62.0, color=palette.PAPER_HORIZON if light else palette.FOG)
    sky_color, ground_color = (214, 226, 255), (54, 58, 72)
    if light:
        sky_color, ground_color = ground_color, sky_color
    scene.add_light_hemisphere("/light/sky", sky_color=sky_color, ground_color=ground_color, intensity=1.9)
    position = (4.0, -6.0, -10.0) if light else (-4.0, 6.0, 10.0)
    scene.add_light_directional("/light/sun", color=(255, 244, 226), intensity=2.2, position=position)


def sky(height: int, width: int, *, light: bool = False) -> NDArray[np.uint8]:
    """Return the background, a vertical gradient of shape [height, width, 3]."""
    top, horizon = (
        (palette.PAPER, palette.PAPER_HORIZON) if light else (palette.SKY_TOP, palette.SKY_HORIZON)
    )  # fmt: skip
    mix = np.linspace(0.0, 1.0, height)[:, None, None]
    rows = (1.0 - mix) * np.array(top) + mix * np.array(horizon)
    return np.repeat(rows, width, axis=1).round().astype(np.uint8)
