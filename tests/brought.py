"""Parts that a distribution of the tests brings, one of each kind."""

from pathlib import Path
from typing import Any

import numpy as np
import viser

from aero_viz.dashboard.layers import Layer
from aero_viz.dashboard.panels import Panel
from aero_viz.recordings.cloud_files import PacketClouds, StampedCloud
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

MAGIC = b"TRIPLES\n"
LIDAR = LidarModel("any name", points_per_sweep=500)


def gate(*, seed: int, ground: bool = True, count: int = 2) -> World:
    """A gate of posts."""
    posts = [[4.0, 0.6 * (-1.0) ** i * (1 + i // 2), 0.0, 0.0, 0.0, 1.0, 0.2, 4.0] for i in range(count)]
    return World.from_dict({"name": f"gate-{seed}", "start": [0, 0, 2], "goal": [8, 0, 2], "cylinders": posts})


def open_triples(path: Path, start: bytes, choices: Any) -> tuple[str, PacketClouds] | None:
    if not start.startswith(MAGIC):
        return None
    points = np.frombuffer(path.read_bytes()[len(MAGIC) :], "<f4").reshape(-1, 3)
    return "triples", PacketClouds(path, "/triples", [StampedCloud(10**9, points, None)])


def greet(*, name: str = "world") -> None:
    """Greet somebody.

    Args:
        name: Whom.
    """
    print(f"Hello, {name}!")


class Nothing(Layer):
    name, title = "nothing", "Nothing"

    def create(self, scene: viser.SceneApi) -> None:
        scene.add_frame("/nothing/frame", show_axes=False)


class Note(Panel):
    title = "Note"

    def create(self, gui: viser.GuiApi) -> None:
        gui.add_markdown("A note.")


class Raising(Panel):
    title = "Raising"

    def create(self, gui: viser.GuiApi) -> None:
        raise KeyError("torn apart")


class RaisingLayer(Layer):
    name, title = "raising", "Raising"

    def create(self, scene: viser.SceneApi) -> None:
        raise KeyError("torn apart")
