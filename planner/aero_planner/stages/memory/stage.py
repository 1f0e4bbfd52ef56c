"""The stage that remembers sweeps: who collects them asks its parameters for how long."""

from __future__ import annotations

from aero_planner.stage import Stage

STAGE = Stage(name="memory", label="Memory")
