"""Decoding of PointCloud2 and Livox messages."""

import bags
import numpy as np
import pytest

from aero_viz.errors import UserError
from aero_viz.recordings import inspect, open_recording


def read(path, index=0):
    with open_recording(path) as recording:
        return recording.sweep(index)


def point_times(sweep):
    assert sweep.point_times is not None
    return sweep.point_times


@pytest.mark.parametrize("code", ["f4", "f8"])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("point_step", [None, 48])
def test_number_formats_and_padding(mcap_of, code, big_endian, point_step):
    columns = {"intensity": np.ones(200, "f4"), **bags.xyz(bags.wall(), code), "ring": np.arange(200, dtype="u2")}
    path = mcap_of([bags.cloud(0, columns, big_endian=big_endian, point_step=point_step)])
    np.testing.assert_array_equal(read(path).points, bags.wall().astype(np.float32))


def test_rows_with_padding_between_them(mcap_of):
    sweep = read(mcap_of([bags.cloud(0, bags.xyz(bags.wall()), height=4, row_padding=7)]))
    np.testing.assert_array_equal(sweep.points, bags.wall().astype(np.float32))


def test_invalid_points_are_dropped_and_counted(mcap_of):
    points, times = bags.wall(), np.arange(200, dtype="u4") * 500_000
    points[3], points[7, 1], points[9, 2], points[11, 0] = 0.0, np.nan, np.inf, 1e7
    sweep = read(mcap_of([bags.cloud(0, {**bags.xyz(points), "t": times})]))
    keep = np.setdiff1d(np.arange(200), [3, 7, 9, 11])
    assert sweep.dropped == 4
    np.testing.assert_array_equal(sweep.points, points[keep].astype(np.float32))
    np.testing.assert_allclose(point_times(sweep), keep * 5e-4, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("t", lambda s, stamp: (s * 1e9).astype("u4")),
        ("offset_time", lambda s, stamp: (s * 1e9).astype("u4")),
        ("time", lambda s, stamp: s.astype("f4")),
        ("time", lambda s, stamp: (s * 1e6).astype("f4")),
        ("timestamp", lambda s, stamp: stamp * 1e-9 + s),
        ("timestamp", lambda s, stamp: stamp + s * 1e9),
        ("timestamp", lambda s, stamp: stamp + (s * 1e9).astype("u8")),
        ("time_offset_ns", lambda s, stamp: (s * 1e9).astype("i4")),
        ("Time_Stamp", lambda s, stamp: (s * 1e6).astype("u4")),
        ("t", lambda s, stamp: s * 1e3),
        ("gps_time", lambda s, stamp: 3e5 + s),
    ],
    ids=[
        "ns u4",
        "livox ns u4",
        "s f4",
        "us f4",
        "absolute s f8",
        "absolute ns f8",
        "absolute ns u8",
        "aeva ns i4",
        "us u4",
        "ms f8",
        "another clock f8",
    ],
)
def test_point_times_in_every_unit(mcap_of, name, values):
    seconds = np.linspace(0, 0.1, 200)
    sweep = read(mcap_of([bags.cloud(0, {**bags.xyz(bags.wall()), name: values(seconds, bags.START)})]))
    np.testing.assert_allclose(point_times(sweep), seconds, atol=2e-6)


def test_times_before_the_stamp(mcap_of):
    seconds = np.linspace(-0.1, 0, 200)
    sweep = read(mcap_of([bags.cloud(0, {**bags.xyz(bags.wall()), "time": seconds.astype("f4")})]))
    np.testing.assert_allclose(point_times(sweep), seconds, atol=1e-7)


@pytest.mark.parametrize("unset", [np.nan, 0.0])
def test_times_of_invalid_points_do_not_matter(mcap_of, unset):
    points, times = bags.wall(), bags.START * 1e-9 + np.linspace(0, 0.1, 200)
    points[:50], times[:50] = np.nan, unset
    sweep = read(mcap_of([bags.cloud(0, {**bags.xyz(points), "timestamp": times})]))
    np.testing.assert_allclose(point_times(sweep), np.linspace(0, 0.1, 200)[50:], atol=2e-6)


def test_the_unit_of_the_times_is_that_of_the_topic(mcap_of):
    seconds = np.linspace(0, 0.1, 200)
    near = bags.wall()
    near[2:] = np.nan  # all that is hit is measured within 0.5 ms, as numbers also 0.5 s
    sweeps = [{**bags.xyz(near if k % 2 else bags.wall()), "t": (1e9 * seconds).astype("u4")} for k in range(6)]
    path = mcap_of([bags.cloud(0.1 * k, columns) for k, columns in enumerate(sweeps)])
    np.testing.assert_allclose(point_times(read(path, 1)), seconds[:2], atol=1e-8)
    np.testing.assert_allclose(point_times(read(path, 2)), seconds, atol=1e-8)


def test_points_without_a_time_get_that_of_their_neighbours(mcap_of):
    seconds = np.linspace(0, 0.1, 200, dtype="f4")
    times = seconds.copy()
    times[[5, 199]] = np.nan
    sweep = read(mcap_of([bags.cloud(0, {**bags.xyz(bags.wall()), "time": times})]))
    np.testing.assert_allclose(point_times(sweep), seconds, atol=6e-4)
    assert len(sweep.points) == 200


def test_constant_time_field_is_ignored(mcap_of):
    sweep = read(mcap_of([bags.cloud(0, {**bags.xyz(bags.wall()), "t": np.zeros(200, "u4")})]))
    assert sweep.point_times is None


def test_unset_stamps_fall_back_to_the_time_of_recording(mcap_of):
    path = mcap_of([bags.cloud(0.1 * k, bags.xyz(bags.wall()), stamped=False) for k in range(3)])
    with open_recording(path) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0, 0.1, 0.2], atol=1e-9)


def test_missing_coordinate_is_named(mcap_of):
    columns = bags.xyz(bags.wall())
    del columns["z"]
    with pytest.raises(UserError, match="lacks z as floating-point fields and has x, y"):
        open_recording(mcap_of([bags.cloud(0, columns)]))


def test_empty_clouds_are_an_error_only_if_all_are_empty(mcap_of):
    empty = [bags.cloud(0.1 * k, bags.xyz(np.empty((0, 3)))) for k in range(3)]
    with pytest.raises(UserError, match=r"No sweep on /points .* has a point: check that"):
        open_recording(mcap_of(empty))
    info = inspect(mcap_of([*empty, bags.cloud(0.3, bags.xyz(bags.wall()))]))
    assert info.sweeps == 1 and "3 of 4 sweeps on /points have no points: left out" in info.problems


def test_clouds_of_invalid_points_only_are_an_error(mcap_of):
    with pytest.raises(UserError, match=r"No sweep on /points .* has a valid point: all are zero"):
        open_recording(mcap_of([bags.cloud(0.1 * k, bags.xyz(np.zeros((5, 3)))) for k in range(3)]))
