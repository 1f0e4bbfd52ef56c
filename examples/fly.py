"""Fly through a scene in closed loop, with a log that `aero-viz play`, Foxglove and RViz can open."""

from pathlib import Path

from aero_planner import PlannerConfig
from aero_viz.flight import fly
from aero_viz.logs import flight_recorder
from aero_viz.scenes import scene

world = scene("forest", seed=3)
config = PlannerConfig().replace({"costs.q_track": 10.0})
log = Path("fly.mcap")

# Without a recorder nothing is written. The same seed and device give the same flight.
result = fly(world, config=config, seed=3, recorder=flight_recorder(log))

print(f"{world.name}: {result.reason} after {result.flight_time_s:.1f} s at {result.mean_speed:.1f} m/s")
print(f"smallest distance from the drone's centre to a surface: {result.min_clearance:.2f} m")
print(f"log: {log}, {log.stat().st_size / 1e6:.1f} MB")
