"""Circles of the segments of a scan, against a walk around the horizon in NumPy."""

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from aero_planner.device.params import Params, pack
from aero_planner.device.records import CloudSweeps, bundle
from aero_planner.kernels.sweep_change import RECENT
from aero_planner.stages.moving_obstacles.segments import (
    BINS,
    BLOCK,
    TRACKS,
    Circles,
    Segments,
    find_segments,
    list_segments,
)
from tests.planner.cases import change_of_sweeps, config_of

L, A, X = int(RECENT), int(BINS), int(TRACKS)
JUMP, GAP, LEAST_BINS, LARGEST_SINE = 0.3, 2, 3, 0.7
WIDTH_MAX = 1.6


def circles_of(scans: NDArray[np.float32], device: str) -> list[NDArray[np.float64]]:
    """Return centre and radius of each circle [m], [n, 3], of scans from the origin [m], [RECENT, BINS]; 0 is empty."""
    entries = np.where(scans > 0.0, 0x7F000000 - scans.view(np.int32), 0)[None]
    origin = wp.zeros((1, L), dtype=wp.vec3, device=device)
    circles = bundle(
        Circles,
        center=wp.zeros((1, L, A), dtype=wp.vec2, device=device),
        radius=wp.zeros((1, L, A), dtype=float, device=device),
        count=wp.zeros((1, L, A // int(BLOCK)), dtype=int, device=device),
    )
    segments = bundle(
        Segments,
        count=wp.empty((1, L), dtype=int, device=device),
        center=wp.zeros((1, L, X), dtype=wp.vec2, device=device),
        radius=wp.empty((1, L, X), dtype=float, device=device),
    )
    params = wp.array(np.array([pack(config_of())]), dtype=Params, device=device)
    change = change_of_sweeps(range(L), device)
    inputs = [change, bundle(CloudSweeps, origin=origin), params, wp.array(entries, device=device)]
    wp.launch(find_segments, (1, L, A), inputs=inputs, outputs=[circles], device=device)
    wp.launch(list_segments, (1, L, A), inputs=[circles], outputs=[segments], device=device)
    found = np.concatenate((segments.center.numpy()[0], segments.radius.numpy()[0, :, :, None]), axis=-1)
    return [found[i, :count].astype(np.float64) for i, count in enumerate(segments.count.numpy()[0])]


def expected_circles(scan: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the circles of one scan [m], [n, 3], by the first bin of their segments."""
    bins = [k for k in range(A) if scan[k] > 0.0]
    segments: list[list[int]] = []
    steps: list[float] = []  # change of the range at the beginning of each segment, 0 after a gap
    for i, k in enumerate(bins):
        before = bins[i - 1] - (A if i == 0 else 0)
        is_near, step = k - before <= GAP, float(scan[k]) - float(scan[before])
        if not is_near or abs(step) > JUMP:
            segments.append([])
            steps.append(step if is_near else 0.0)
        if segments:
            segments[-1].append(k)
    if segments:
        segments[-1] += [k + A for k in bins if k < segments[0][0]]
    circles = []
    for i, segment in enumerate(segments):
        is_hidden = steps[i] > 0.0 or steps[(i + 1) % len(steps)] < 0.0  # by a nearer one, at either end
        first, last = segment[0], segment[-1]
        count = last - first + 1
        sine = np.sin(0.5 * (count - 0.5) * 2.0 * np.pi / A)
        middle = range(first + count // 3, last - count // 3 + 1)
        ranges = [float(scan[k % A]) for k in middle if scan[k % A] > 0.0]
        if is_hidden or not LEAST_BINS <= count <= A // 3 or sine > LARGEST_SINE or not ranges:
            continue
        radius = np.mean(ranges) * sine / (1.0 - sine)
        angle = (first + last + 1) * np.pi / A - np.pi
        if 2.0 * radius <= WIDTH_MAX:
            distance = np.mean(ranges) + radius
            circles.append((distance * np.cos(angle), distance * np.sin(angle), radius))
    return np.array(circles).reshape(-1, 3)[:X]


def random_scans(rng: np.random.Generator, objects: int) -> NDArray[np.float32]:
    """Return scans of objects before and behind each other, some of whose bins are empty, [RECENT, BINS] [m]."""
    scans = np.zeros((L, A), np.float32)
    for scan in scans:
        for _ in range(objects):
            bins = (rng.integers(A) + np.arange(rng.integers(1, 60))) % A
            distance = rng.uniform(2.0, 9.0) + rng.uniform(-0.1, 0.1, len(bins))
            scan[bins] = np.where(scan[bins] > 0.0, np.minimum(scan[bins], distance), distance)
        scan[rng.random(A) < 0.1] = 0.0
    return scans


@pytest.mark.parametrize("objects", [1, 6, 25, 90])
def test_segments_are_those_of_a_walk_around_the_horizon(device: str, objects: int):
    scans = random_scans(np.random.default_rng(objects), objects)
    expected = [expected_circles(scan) for scan in scans]
    assert any(map(len, expected))
    for found, circles in zip(circles_of(scans, device), expected, strict=True):
        np.testing.assert_allclose(found, circles, atol=1e-4)


@pytest.mark.parametrize("scan", [np.zeros(A), np.full(A, 4.0), np.where(np.arange(A) % 2, 4.0, 0.0)])
def test_a_scan_without_ends_has_no_segments(device: str, scan: NDArray[np.float64]):
    scans = np.tile(scan.astype(np.float32), (L, 1))
    assert all(len(circles) == 0 for circles in circles_of(scans, device))


def test_no_more_circles_are_listed_than_there_is_room_for(device: str):
    scan = np.where(np.arange(A) % 8 < 4, 3.0, 0.0).astype(np.float32)
    assert [len(circles) for circles in circles_of(np.tile(scan, (L, 1)), device)] == [X] * L
