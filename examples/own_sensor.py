"""Add a LiDAR: 32 rings, tilted down, so that they see the ground ahead.

It has a name in every command of aero-viz, such as `own_sensor.py demo forest --lidar tilted32`. Without a command, its
coverage is printed, and it flies beside the Mid-360. Its fields are those of `LidarModel`.
"""

import sys

from aero_viz.cli import main
from aero_viz.flight import fly
from aero_viz.scenes import scene
from aero_viz.sensors import LIDARS, LidarModel, coverage

tilted = LidarModel(
    "tilted32",
    pattern="rings",
    rings=32,
    points_per_sweep=32 * 600,
    elevation_min=-25.0,  # [deg], in the frame of the sensor
    elevation_max=25.0,
    range_max=60.0,  # [m]
    range_noise=0.03,  # [m]
    mount_position=(0.1, 0.0, 0.05),  # [m], in the frame of the body
    mount_angles=(0.0, 10.0, 0.0),  # roll, pitch, yaw [deg]: pitched down
)
LIDARS.add("tilted32", tilted)


def compare() -> None:
    """Fly the same world with both sensors."""
    world = scene("random_clutter", seed=2)
    for name in ("mid360", "tilted32"):
        seen = 100.0 * coverage(LIDARS[name], times=(0.1, 1.0))
        result = fly(world, lidar=LIDARS[name], seed=1)
        print(
            f"{name}: {result.reason}, at least {result.min_clearance:.2f} m from everything; "
            f"{seen[0]:.0f} % of its view seen after 0.1 s, {seen[1]:.0f} % after 1 s"
        )


if __name__ == "__main__":
    main() if sys.argv[1:] else compare()
