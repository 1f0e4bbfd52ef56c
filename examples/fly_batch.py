"""Compare values of a weight over several flights that advance together. With device="cuda:0" it can be hundreds."""

import numpy as np

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch
from aero_viz.scenes import scene

WEIGHTS = (5.0, 15.0)
SEEDS = (1, 2)

pairs = [(weight, seed) for weight in WEIGHTS for seed in SEEDS]
batch = FlightBatch(
    [scene("random_clutter", seed=seed) for _, seed in pairs],
    config=[PlannerConfig().replace({"costs.q_track": weight}) for weight, _ in pairs],
    config_names=[f"q_track {weight:g}" for weight, _ in pairs],
    device="cpu",
)
results = batch.run()

for weight in WEIGHTS:
    flights = [result for result in results if result.config == f"q_track {weight:g}"]
    arrived = [result for result in flights if result.arrived]
    mean_time = np.mean([result.flight_time_s for result in arrived]) if arrived else np.nan
    print(f"q_track {weight:4g}: {len(arrived)} of {len(flights)} arrived, after {mean_time:.1f} s on average")
