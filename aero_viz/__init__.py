"""AERO-Viz: a web dashboard and test bench for the AERO-MPPI planner."""

import aero_planner  # noqa: F401 (first of all, it takes the current folder off the path of "python -m")
