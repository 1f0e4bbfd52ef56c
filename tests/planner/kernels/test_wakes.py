"""Points of moving obstacles in older sweeps, which are left out of the partition."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Planner, Sweeps
from aero_planner.kernels.movers import MOVERS
from aero_planner.device.params import Params, pack
from aero_planner.device.records import CloudSweeps, bundle
from aero_planner.kernels.wakes import WAKES, find_wakes
from tests.planner.cases import change_of_sweeps, config_of, kept_points
from tests.planner.pillars import RADIUS, Array, plan_from, sweeps_of

AXIS = np.array([5.0, 1.0])


def config_without_surfaces(**changes: Any):
    off = {"partition__continue_below": 0.0, "partition__continue_above": 0.0}
    return config_of(**{"partition__predict_wake_speed": 50.0, **off, **changes})


def distances(points: Array, axis: Array) -> Array:
    """Return the distances from the surface of a pillar [m]."""
    return np.linalg.norm(points[:, :2] - axis, axis=1) - RADIUS


@pytest.mark.parametrize("count", [9, 12, 26])
def test_what_a_pillar_has_left_is_free(device: str, count: int):
    velocity = np.array([0.0, 1.0])
    sweeps, position = sweeps_of([(AXIS, velocity)], np.zeros(3), count=count)
    middle = AXIS - 0.05 * velocity  # where the newest sweep shows it
    kept = distances(
        kept_points(plan_from(Planner(config_without_surfaces(), device=device), sweeps, position)), middle
    )
    assert len(kept) > 20 and np.abs(kept).max() < 0.06
    planner = Planner(config_without_surfaces(partition__predict_wake_speed=0.0), device=device)
    assert distances(kept_points(plan_from(planner, sweeps, position)), middle).max() > 0.4


def test_pillars_that_stand_keep_the_points_of_all_sweeps(device: str):
    """Also one behind a pillar that moves, and one that sweeps have not shown for a second."""
    moving, beside, gone = AXIS, np.array([5.5 + 2.0 * RADIUS, 0.0]), np.array([-4.0, 0.0])
    sweeps, position = sweeps_of([(moving, np.array([0.0, 1.0])), (beside, np.zeros(2))], np.zeros(3), count=20)
    old = sweeps_of([(gone, np.zeros(2))], np.zeros(3), count=1)[0]
    seen_first = Sweeps(
        [np.concatenate((points, *old)) if k < 10 else points for k, points in enumerate(sweeps)],
        arrivals=sweeps.arrivals,
    )
    with_wakes, without = (
        kept_points(plan_from(Planner(config_without_surfaces(**changes), device=device), seen_first, position))
        for changes in ({}, {"partition__predict_wake_speed": 0.0})
    )
    shown, hidden = (points[np.abs(distances(points, beside)) < 0.06] for points in (with_wakes, without))
    assert len(shown) > 10 and len(hidden) == 0  # by what the moving one has left
    expected = {tuple(point) for point in without[np.abs(distances(without, gone)) < 0.06].tolist()}
    assert len(expected) > 10 and expected <= {tuple(point) for point in with_wakes.tolist()}


def test_a_pillar_that_cannot_be_seen_any_more_stays_where_it_was_last_seen(device: str):
    sweeps, position = sweeps_of([(AXIS, np.array([0.0, 1.0]))], np.zeros(3), count=20)
    hidden = Sweeps(
        [points if k < 15 else np.zeros((0, 3), np.float32) for k, points in enumerate(sweeps)],
        arrivals=sweeps.arrivals,
    )
    last_seen = AXIS - 0.55 * np.array([0.0, 1.0])
    kept = distances(
        kept_points(plan_from(Planner(config_without_surfaces(), device=device), hidden, position)), last_seen
    )
    assert len(kept) > 20 and np.abs(kept).max() < 0.06


def reference_wakes(
    sweep: int, times: Array, tracked_from: list[int], tracks: list[list[tuple[Array, Array, float]]], oldest: int
) -> list[tuple[Array, float]]:
    """Return axis [m] and radius [m] of the wakes of a sweep; the sweeps are in the order of arrival."""
    wakes: list[tuple[Array, float]] = []
    usable = [k for k in range(oldest + 1, len(times)) if tracked_from[k] >= tracked_from[k - 1] >= oldest]
    for k in usable:
        elapsed = times[k] - times[sweep]
        if elapsed > 0.0 and (elapsed < 0.65 or k == usable[0]):
            for i, (position, velocity, radius) in enumerate(tracks[k]):
                place = position - elapsed * velocity
                before = tracks[k - 1][i][0] + (times[k] - times[k - 1]) * velocity
                if np.linalg.norm(before - position) < 0.25 and not any(
                    np.linalg.norm(p - place) < 0.08 and abs(r - radius - 0.15) < 0.08 for p, r in wakes
                ):
                    wakes.append((place, radius + 0.15))
    return wakes


def test_wakes_are_the_tracks_of_the_sweeps_that_follow(device: str):
    rng = np.random.default_rng(5)
    S, X, count, oldest = 14, int(MOVERS), 3, 2
    row_of = rng.permutation(S)  # number to row
    times = np.array([3.0 + 0.1 * k for k in range(S)])
    tracked_from = [k - 7 if k >= 7 else -1 for k in range(S)]
    places, speeds, radii = rng.uniform(-9, 9, (count, 2)), rng.uniform(-1.5, 1.5, (count, 2)), rng.uniform(0.2, 0.6, 3)
    tracks = [
        [
            (places[i] + times[k] * speeds[i] + rng.normal(0.0, 0.08, 2), speeds[i], float(radii[i]))
            for i in range(count)
        ]
        for k in range(S)
    ]
    host = {
        "number": np.empty(S, np.int32), "tracked_from": np.empty(S, np.int32), "time": np.empty((1, S)),
        "track_seen": np.full((1, S), count, np.int32), "track_position": np.zeros((1, S, X, 2), np.float32),
        "track_velocity": np.zeros((1, S, X, 2), np.float32), "track_radius": np.zeros((1, S, X), np.float32),
    }  # fmt: skip
    for k in range(S):
        row = row_of[k]
        host["number"][row], host["tracked_from"][row], host["time"][0, row] = k, tracked_from[k], times[k]
        for i, (position, velocity, radius) in enumerate(tracks[k]):
            host["track_position"][0, row, i], host["track_velocity"][0, row, i] = position, velocity
            host["track_radius"][0, row, i] = radius
    kinds: dict[str, Any] = {"time": wp.float64, "track_position": wp.vec2, "track_velocity": wp.vec2}
    kinds |= dict.fromkeys(("number", "tracked_from", "track_seen"), wp.int32)
    shape: Any = (1, S, int(WAKES))
    cloud = bundle(
        CloudSweeps,
        **{name: wp.array(v, dtype=kinds.get(name, wp.float32), device=device) for name, v in host.items()},
        wake_count=wp.zeros((1, S), dtype=int, device=device),
        wake_position=wp.zeros(shape, dtype=wp.vec2, device=device),
        wake_velocity=wp.zeros(shape, dtype=wp.vec2, device=device),
        wake_radius=wp.zeros(shape, dtype=float, device=device),
    )
    params = wp.array(np.array([pack(config_of(partition__predict_wake_speed=50.0))]), dtype=Params, device=device)
    change = change_of_sweeps((), device, number=S - 1, oldest=oldest)
    wp.launch(find_wakes, (1, S), inputs=[change, params], outputs=[cloud], device=device)
    for k in range(S):
        expected = reference_wakes(k, times, tracked_from, tracks, oldest) if oldest <= k < S - 1 else []
        found = cloud.wake_count.numpy()[0, row_of[k]]
        assert found == len(expected)
        if expected:
            positions = cloud.wake_position.numpy()[0, row_of[k], :found]
            np.testing.assert_allclose(positions, [place for place, _ in expected], atol=1e-4)
            np.testing.assert_allclose(
                cloud.wake_radius.numpy()[0, row_of[k], :found], [radius for _, radius in expected], rtol=1e-5
            )
    assert cloud.wake_count.numpy().max() > count  # tracks that differ are all kept
