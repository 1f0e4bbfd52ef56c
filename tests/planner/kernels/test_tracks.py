"""Motion of circles that are found in several sweeps."""

import numpy as np
import warp as wp

from aero_planner.kernels.motion import BINS, RECENT, RecentRows, Segments
from aero_planner.kernels.movers import MOVERS
from aero_planner.kernels.params import Params, pack
from aero_planner.kernels.records import CloudSweeps, bundle
from aero_planner.kernels.tracks import LENGTH, STARTS, FoundTracks, follow_segments
from tests.planner.cases import config_of
from tests.planner.pillars import PERIOD


def test_uniform_motion_is_fitted_by_least_squares(device: str):
    """The fit is that of NumPy, over the sweeps that show the segment; the others keep their places."""
    rng = np.random.default_rng(3)
    L, X, config = int(RECENT), int(MOVERS), config_of()
    times = 5.0 - PERIOD * np.arange(L)
    starts, speeds = 4.0 * np.arange(6)[:, None] * np.ones(2), rng.uniform(-1.5, 1.5, (6, 2))
    centers = np.zeros((1, L, X, 2), np.float32)
    centers[0, :, :6] = starts + (times - 5.0)[:, None, None] * speeds + 0.01 * rng.normal(size=(L, 6, 2))
    radii = np.full((1, L, X), 0.3, np.float32)
    segments = bundle(
        Segments,
        count=wp.array(np.full((1, L), 6, np.int32), device=device),
        center=wp.array(centers, dtype=wp.vec2, device=device),
        radius=wp.array(radii, dtype=float, device=device),
    )
    cloud = bundle(
        CloudSweeps,
        time=wp.array(times[None], dtype=wp.float64, device=device),
        origin=wp.zeros((1, L), dtype=wp.vec3, device=device),
    )
    empty_scan = wp.zeros((1, L, int(BINS)), dtype=int, device=device)
    shape = (1, int(STARTS), X)
    found = bundle(
        FoundTracks,
        position=wp.zeros(shape, dtype=wp.vec2, device=device),
        velocity=wp.zeros(shape, dtype=wp.vec2, device=device),
        radius=wp.zeros(shape, dtype=float, device=device),
    )
    params = wp.array(np.array([pack(config)]), dtype=Params, device=device)
    rows = RecentRows(*range(L))
    wp.launch(
        follow_segments, shape, inputs=[rows, cloud, params, empty_scan, segments], outputs=[found], device=device
    )
    for begin in range(int(STARTS)):
        t, x = times[begin : begin + int(LENGTH)], centers[0, begin : begin + int(LENGTH), :6].astype(np.float64)
        for i in range(6):
            slope, at_newest = np.polyfit(t - 5.0, x[:, i], 1)
            if np.linalg.norm(slope) > 0.8:
                np.testing.assert_allclose(found.velocity.numpy()[0, begin, i], slope, atol=1e-4)
                expected = at_newest + 0.5 * PERIOD * slope
                np.testing.assert_allclose(found.position.numpy()[0, begin, i], expected, atol=1e-4)
                np.testing.assert_allclose(found.radius.numpy()[0, begin, i], 0.3, rtol=1e-5)
        assert (found.radius.numpy()[0, begin, 6:] == -1.0).all()
    assert (np.linalg.norm(speeds, axis=1) > 0.8).sum() >= 3
