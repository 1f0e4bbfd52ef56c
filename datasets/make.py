"""Makes the recordings that ship: `.venv/bin/python datasets/make.py`. The result is the same, byte for byte.

Two flights of the simulated drone with a simulated Livox Mid-360, without noise of the state estimate. To keep the
files small, one ray of 89, one pose of four and one plan of twenty are kept, coordinates are rounded to 1/16 m and
times to 1 ms, and the compression is strong.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from unittest.mock import patch

import zstandard

from aero_planner.config import PlannerConfig
from aero_viz.catalog import SHIPPED_FOLDER
from aero_viz.logs.sensor_log import SensorLogOptions, write_sensor_log
from aero_viz.scenes import scene

OPTIONS = SensorLogOptions(every=89, pose_every=4, resolution=1 / 16, time_resolution=1e-3, plan_period=0.4)


def main() -> None:
    """Write both recordings and print their outcomes and sizes."""
    compress = partial(zstandard.compress, level=19)  # mcap's writer has no setting for the level
    for name, world, speed, options in (
        ("forest_mid360", scene("forest", seed=3), 7.0, OPTIONS),
        ("room_mid360", scene("pillars", seed=1), 1.5, dataclasses.replace(OPTIONS, duration=1.0)),
    ):
        path = SHIPPED_FOLDER / f"{name}.mcap"
        part = SHIPPED_FOLDER / f"{name}.part.mcap"  # a run that is interrupted leaves the recording as it was
        with patch("zstandard.compress", compress):
            result = write_sensor_log(world, part, config=PlannerConfig(), seed=3, speed=speed, options=options)
        part.replace(path)
        print(f"{path.name}: {result.reason or 'cut'} after {result.flight_time_s:.1f} s, {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
