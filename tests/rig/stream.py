"""A companion computer that flies straight to the goal or hovers, for tests of the rig that need no planner."""

import sys
import time
from pathlib import Path

import numpy as np

from aero_planner.config import VehicleConfig
from aero_planner.onboard.connections import open_link
from aero_planner.onboard.flight_config import load_flight_config
from aero_planner.onboard.livox import LivoxSource
from aero_planner.quaternions import conjugate, rotate

PERIOD = 0.02


def main(config: Path, speed: float) -> None:
    """Stream commands that keep a velocity towards the goal, once goal, state and points have arrived."""
    _, onboard = load_flight_config(config)
    lidar = LivoxSource(onboard.lidar.port, host=onboard.lidar.host)
    link = open_link(onboard, VehicleConfig())
    has_points = False
    print("streaming", flush=True)
    due = time.monotonic()
    while True:
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
        link.poll()
        has_points |= any(len(packet.points) for packet in lidar.poll())
        sample = link.state
        if sample is None or link.goal is None or not has_points:
            continue
        p, v, q = (
            np.asarray(x, dtype=float) for x in (sample.state.position, sample.state.velocity, sample.state.quaternion)
        )
        direction = link.goal - p
        target_velocity = speed * direction / max(float(np.linalg.norm(direction)), speed)
        force = np.clip(2.0 * (target_velocity - v), -4.0, 4.0) + np.array([0.0, 0.0, 9.81])
        up = rotate(q, [0.0, 0.0, 1.0])
        rates = 6.0 * rotate(conjugate(q), np.cross(up, force / np.linalg.norm(force)))
        link.send([float(force @ up), rates[0], rates[1], 0.0])


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
