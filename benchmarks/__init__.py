"""Benchmarks of the planner: a naive reference, other libraries, lower bounds and scaling.

Run them from the root of the repository, for example `python -m benchmarks.guard`; see docs/speed.md.
"""
