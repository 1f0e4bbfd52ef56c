"""AERO-Viz: interactive web visualizer and tuning dashboard for the AERO-MPPI planner."""
