"""Many flights: benchmarks, parameter tuning, and scores of flights by other planners."""
