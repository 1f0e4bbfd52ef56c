"""First-order lags."""

import numpy as np
import warp as wp

from aero_planner.device.lag import lag_share


@wp.kernel
def shares(lag: wp.array(dtype=float), time: wp.array(dtype=float), out: wp.array(dtype=float)):
    out[wp.tid()] = lag_share(lag[wp.tid()], time[wp.tid()])


def test_a_difference_decays_exponentially(device: str):
    lag, time = np.array([0.0, 0.0, 0.05, 0.05, 2.0], np.float32), np.array([0.0, 1.0, 0.0, 0.1, 0.02], np.float32)
    out = wp.zeros(5, dtype=float, device=device)
    inputs = [wp.array(values, dtype=float, device=device) for values in (lag, time)]
    wp.launch(shares, 5, inputs=inputs, outputs=[out], device=device)
    np.testing.assert_allclose(out.numpy(), [0.0, 0.0, 1.0, np.exp(-2.0), np.exp(-0.01)], rtol=1e-6)
