"""The stage that thins old sweeps."""

from __future__ import annotations

from aero_planner.kernels.shells import thin_sweep
from aero_planner.recorder import Recorder
from aero_planner.stage import Launches, Stage


def _thin(r: Recorder) -> list[list[Launches]]:
    """Remove most points of the sweep that is thinned."""
    inputs, size = [r.threads_per_sweep, r.change], (r.sizes.B, r.threads_per_sweep)
    return [[[r.record(thin_sweep, size, inputs=inputs, outputs=[r.sweeps])]]]


STAGE = Stage(name="memory", label="Memory", launches={"cloud": _thin})
