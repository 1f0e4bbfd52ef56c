"""Fly through a scene in closed loop, with a log that `aero-viz play`, Foxglove and RViz can open."""

from pathlib import Path

from aero_planner import PlannerConfig
from aero_viz.logs import fly_and_log
from aero_viz.scenes import scene

world = scene("forest", seed=3)
config = PlannerConfig().replace({"costs.q_track": 10.0})
log = Path("flight.mcap")

# `aero_viz.flight.fly` does the same without a log. The same seed and device give the same flight.
result = fly_and_log(world, log, config=config, seed=3)

print(f"{world.name}: {result.reason} after {result.flight_time_s:.1f} s at {result.mean_speed:.1f} m/s")
print(f"smallest distance from the drone's centre to a surface: {result.min_clearance:.2f} m")
print(f"log: {log}, {log.stat().st_size / 1e6:.1f} MB")
