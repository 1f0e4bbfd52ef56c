"""Run the planner on a recording, open loop: python examples/replay_recording.py [RECORDING].

Without an argument, a short flight is recorded first. A recording is an MCAP file, a ROS 2 bag or a ROS 1 bag with
point clouds and poses, see datasets/README.md.
"""

import sys
from pathlib import Path

import numpy as np

from aero_planner import PlanStatus
from aero_viz.errors import UserError
from aero_viz.flight import FlightRules, fly
from aero_viz.logs import flight_recorder
from aero_viz.recordings import RecordingSource, inspect, open_recording
from aero_viz.scenes import scene
from aero_viz.session import Session


def record_flight() -> Path:
    path = Path("replay_recording.mcap")
    fly(scene("forest", seed=1), rules=FlightRules(time_limit=1.0), recorder=flight_recorder(path))
    return path


path = Path(sys.argv[1]) if len(sys.argv) > 1 else record_flight()
try:
    info, recording = inspect(path), open_recording(path)
except UserError as error:  # its message is written for the user
    sys.exit(f"replay_recording.py: {error}")
print(f"{path.name}: {info.format}, {info.duration_s:.1f} s, {info.sweeps} sweeps, {info.poses} poses")

session = Session(RecordingSource(recording, goal_ahead=8.0))
frame = session.tick()
while frame.outcome is None:
    if frame.index % 10 == 0:
        position = np.asarray(frame.observation.state.position)
        distance = np.linalg.norm(frame.plan.positions[frame.plan.best, -1] - position)
        print(f"{frame.time:5.2f} s  {PlanStatus(frame.plan.status).name:17}  plans {distance:.1f} m ahead")
    frame = session.tick()
session.close()
