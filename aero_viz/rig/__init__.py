"""The rig: the onboard node against a simulated autopilot and LiDAR, over real sockets, with injected faults."""

from aero_viz.rig.faults import FAULT_KINDS, Fault, parse_fault
from aero_viz.rig.result import Event, Intervals, RigResult, Trajectory
from aero_viz.rig.rig import fly_rig

__all__ = ["FAULT_KINDS", "Event", "Fault", "Intervals", "RigResult", "Trajectory", "fly_rig", "parse_fault"]
