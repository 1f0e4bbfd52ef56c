"""The result of a flight on the rig, made by hand."""

import numpy as np

from aero_viz.rig.result import Event, Intervals, RigResult, Trajectory

_EMPTY = np.zeros((0, 3))
RESULT = RigResult(
    arrived=True, reason="arrived", arrivals=1, flight_time_s=9.3, mean_speed=4.6, max_speed=5.2,
    min_clearance=0.71, scene="forest", seed=3, faults=[], events=[Event(9.3, "arrived")], setpoints=465,
    refused=0, violations=[], intervals=Intervals(464, 0.02, 0.0004, 0.0212, 0.031, 1),
    sign_changes=(1.5, 2.04, 0.0), overruns=0, log=[],
    trajectory=Trajectory(_EMPTY[:, 0], _EMPTY, _EMPTY, _EMPTY[:, 0] > 0.0), commands=[],
)  # fmt: skip
