"""What judges the planner's speed: a naive reference beside it, other libraries, floors and scaling.

Run from the repository's root, for example `python -m benchmarks.guard`; see docs/speed.md.
"""
