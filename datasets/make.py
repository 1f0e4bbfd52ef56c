"""Makes the recordings in this folder: `.venv/bin/python datasets/make.py`. The result is the same, byte for byte.

Two flights of the simulated drone with a simulated Livox Mid-360, without noise of the state estimate. One ray of 31 is
kept, and coordinates are rounded to 1/32 m, so that the files are small.
"""

from __future__ import annotations

from pathlib import Path

from aero_planner.config import PlannerConfig
from aero_viz.logs.sensor_log import SensorLogOptions, write_sensor_log
from aero_viz.scenes import scene

FOLDER = Path(__file__).parent
OPTIONS = SensorLogOptions(every=31, resolution=1 / 32)


def main() -> None:
    """Write both recordings and print their outcomes and sizes."""
    room = SensorLogOptions(every=31, resolution=1 / 32, duration=1.0)
    for name, world, speed, options in (
        ("forest_mid360", scene("forest", seed=3), 5.0, OPTIONS),
        ("room_mid360", scene("pillars", seed=1), 1.5, room),
    ):
        path = FOLDER / f"{name}.mcap"
        result = write_sensor_log(world, path, config=PlannerConfig(), seed=3, speed=speed, options=options)
        print(f"{path.name}: {result.reason or 'cut'} after {result.flight_time_s:.1f} s, {path.stat().st_size} bytes")


if __name__ == "__main__":
    main()
