"""First-order lag."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def lag_share(lag: float, time: float) -> float:
    """Return the share of a difference to the command that remains after `time`; 0 without a lag."""
    return wp.where(lag > 0.0, wp.exp(-time / wp.max(lag, 1.0e-6)), 0.0)
