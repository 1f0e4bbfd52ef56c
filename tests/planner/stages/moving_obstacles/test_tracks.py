"""Motion of circles that are found in several sweeps."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from aero_planner.device.params import Params, pack
from aero_planner.device.records import CloudSweeps, bundle
from aero_planner.kernels.sweep_change import RECENT
from aero_planner.stages.moving_obstacles.segments import BINS, TRACKS, Segments
from aero_planner.stages.moving_obstacles.tracks import LENGTH, STARTS, FoundTracks, follow_segments
from tests.planner.cases import change_of_sweeps, config_of
from tests.planner.pillars import PERIOD

TIMES = 5.0 - PERIOD * np.arange(int(RECENT))
"""Arrival of each sweep, newest first [s]."""


def follow(centers: NDArray[np.float32], device: str, *, scan: NDArray[np.int32] | None = None) -> Any:
    """Follow circles of radius 0.3 m with these `centers` [m], [RECENT, n, 2], through scans from the origin."""
    L, X, n = int(RECENT), int(TRACKS), centers.shape[1]
    padded = np.zeros((1, L, X, 2), np.float32)
    padded[0, :, :n] = centers
    segments = bundle(
        Segments,
        count=wp.array(np.full((1, L), n, np.int32), device=device),
        center=wp.array(padded, dtype=wp.vec2, device=device),
        radius=wp.full((1, L, X), 0.3, dtype=float, device=device),
    )
    cloud = bundle(
        CloudSweeps,
        time=wp.array(TIMES[None], dtype=wp.float64, device=device),
        origin=wp.zeros((1, L), dtype=wp.vec3, device=device),
    )
    shape = (1, int(STARTS), X)
    found = bundle(
        FoundTracks,
        position=wp.zeros(shape, dtype=wp.vec2, device=device),
        velocity=wp.zeros(shape, dtype=wp.vec2, device=device),
        radius=wp.zeros(shape, dtype=float, device=device),
    )
    params = wp.array(np.array([pack(config_of())]), dtype=Params, device=device)
    bins = np.zeros((1, L, int(BINS)), np.int32) if scan is None else scan[None]
    change = change_of_sweeps(range(L), device)
    inputs = [change, cloud, params, wp.array(bins, dtype=int, device=device), segments]
    wp.launch(follow_segments, shape, inputs=inputs, outputs=[found], device=device)
    return found


def test_uniform_motion_is_fitted_by_least_squares(device: str):
    """The fit is that of NumPy, over the sweeps that show the segment; the others keep their places."""
    rng = np.random.default_rng(3)
    starts, speeds = 4.0 * np.arange(6)[:, None] * np.ones(2), rng.uniform(-1.5, 1.5, (6, 2))
    centers = starts + (TIMES - 5.0)[:, None, None] * speeds + 0.01 * rng.normal(size=(len(TIMES), 6, 2))
    centers = centers.astype(np.float32)
    found = follow(centers, device)
    for begin in range(int(STARTS)):
        t, x = TIMES[begin : begin + int(LENGTH)], centers[begin : begin + int(LENGTH)].astype(np.float64)
        for i in range(6):
            slope, at_newest = np.polyfit(t - 5.0, x[:, i], 1)
            if np.linalg.norm(slope) > 0.8:
                np.testing.assert_allclose(found.velocity.numpy()[0, begin, i], slope, atol=1e-4)
                expected = at_newest + 0.5 * PERIOD * slope
                np.testing.assert_allclose(found.position.numpy()[0, begin, i], expected, atol=1e-4)
                np.testing.assert_allclose(found.radius.numpy()[0, begin, i], 0.3, rtol=1e-5)
        assert (found.radius.numpy()[0, begin, 6:] == -1.0).all()
    assert (np.linalg.norm(speeds, axis=1) > 0.8).sum() >= 3


def scan_entry(distance: float) -> int:
    """Return the entry of a bin for a range [m], as `scan_obstacles` writes it."""
    return 0x7F000000 - int(np.float32(distance).view(np.int32))


def is_found(x: NDArray[Any], scan: NDArray[np.int32], device: str) -> bool:
    """Return True if a segment at the places `x` [m], [RECENT, 2], is found to move in the newest sweep."""
    return bool(follow(x[:, None].astype(np.float32), device, scan=scan).radius.numpy()[0, 0, 0] > 0.0)


ACROSS = np.stack((np.full(len(TIMES), 5.0), 1.5 * (TIMES - 5.0)), axis=-1)
"""Places of a segment that moves across the line of sight."""


@pytest.mark.parametrize(("shown", "moves"), [(8.0, True), (4.7, False), (2.0, False), (None, True)])
def test_a_segment_has_moved_if_its_places_are_free_at_other_times(device: str, shown: float | None, moves: bool):
    """The scans show something behind its places, at them, before them, or nothing."""
    entry = 0 if shown is None else scan_entry(shown)
    assert is_found(ACROSS, np.full((len(TIMES), int(BINS)), entry, np.int32), device) == moves


@pytest.mark.parametrize(
    ("sweep", "place", "moves"), [(0, 5, False), (5, 0, False), (0, 0, True), (5, 5, True), (3, 5, True), (3, 0, True)]
)
def test_only_the_newest_and_the_oldest_scan_tell_where_a_segment_was(device: str, sweep: int, place: int, moves: bool):
    """One scan shows something at one of its places, the others show free space."""
    scan = np.full((len(TIMES), int(BINS)), scan_entry(9.0), np.int32)
    azimuth = (np.arange(int(BINS)) + 0.5) / int(BINS) * 2.0 * np.pi - np.pi
    # A little wider than the disk, and the other scan sees through its other place with as many bins.
    toward = np.abs(azimuth - np.arctan2(*ACROSS[place][::-1])) < np.arcsin(0.3 / 5.0) + 0.03
    scan[sweep, toward] = scan_entry(4.7)
    if not moves:
        scan[5 - sweep, np.abs(azimuth - np.arctan2(*ACROSS[5 - place][::-1])) < 0.03] = scan_entry(4.7)
    assert is_found(ACROSS, scan, device) == moves


def test_a_segment_that_moves_along_the_line_of_sight_is_found(device: str):
    x = np.stack((5.0 - 1.5 * (TIMES - 5.0), np.zeros(len(TIMES))), axis=-1)
    scan = np.array([np.full(int(BINS), scan_entry(place[0] - 0.3)) for place in x], np.int32)
    assert is_found(x, scan, device)
