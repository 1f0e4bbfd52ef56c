"""Preparation of a drone that has no compiler: ahead-of-time kernels, bundles, export."""
