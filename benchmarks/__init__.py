"""Benchmarks of the planner: the reference of the paper, other libraries, lower bounds and scaling.

Run them from the root of the repository, for example `python -m benchmarks.guard`; see docs/benchmarks.md.
"""
