"""AERO-Viz: a web dashboard and test bench for the AERO-MPPI planner."""
