"""Add a scene: a corridor with walls across it, each with a gap on the left or on the right, by seed.

It has a name in every command of aero-viz, such as `own_scene.py demo slalom --count 6` or `own_scene.py tune slalom`;
`aero-viz demo own_scene:slalom` needs no script. Without a command, it is flown through.
"""

import sys

import numpy as np

from aero_viz.cli import main
from aero_viz.flight import fly
from aero_viz.scenes import SCENES, World, scene

SPACING, WIDTH, HEIGHT, GAP = 6.0, 10.0, 4.0, 3.0  # [m]


def slalom(*, seed: int, ground: bool = True, count: int = 3) -> World:
    """A corridor with walls across it, each with a gap of 3 m on one side."""
    sides = np.random.default_rng(seed).choice([-1.0, 1.0], size=count)
    end = SPACING * (count + 1)
    boxes = [  # centre, edge lengths [m], yaw [rad]
        [SPACING * (i + 1), 0.5 * GAP * side, 0.5 * HEIGHT, 0.3, WIDTH - GAP, HEIGHT, 0.0]
        for i, side in enumerate(sides)
    ]
    boxes += [[0.5 * end, 0.5 * WIDTH * side, 0.5 * HEIGHT, end + 6.0, 0.3, HEIGHT, 0.0] for side in (-1.0, 1.0)]
    boxes += [[0.5 * end, 0.0, HEIGHT, end + 6.0, WIDTH, 0.3, 0.0]]  # a ceiling
    boxes += [[0.5 * end, 0.0, -0.5, end + 6.0, WIDTH, 1.0, 0.0]] if ground else []
    return World(f"slalom-{count}-{seed}", np.array([0.0, 0.0, 1.5]), np.array([end, 0.0, 1.5]), boxes=np.array(boxes))


SCENES.add("slalom", slalom)

if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit(main())
    result = fly(scene("slalom", seed=1, count=2), seed=1, speed=5.0)
    print(f"{result.scene}: {result.reason} after {result.flight_time_s:.1f} s, {result.length_m:.1f} m")
