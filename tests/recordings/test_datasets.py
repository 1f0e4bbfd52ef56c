"""Real recordings, if the folder of shared datasets is beside the checkout."""

import numpy as np
import pytest

from aero_viz.recordings import RecordingSource, inspect, open_recording


@pytest.mark.parametrize("inner", ["", "hilti_os0_A_mcap.mcap"])
def test_hilti(shared_datasets, inner):
    info = inspect(shared_datasets / "hilti_os0_A_mcap" / inner)
    assert info.sweeps == 24 and info.poses == 24 and info.problems == ()
    assert info.duration_s == pytest.approx(11.5, abs=0.01)
    assert info.points_per_sweep is not None and info.points_per_sweep.min > 18_000
    assert info.points_per_sweep.max < 23_000
    with open_recording(shared_datasets / "hilti_os0_A_mcap" / inner) as recording:
        assert recording.poses is not None and not recording.poses.measured_velocity
        assert np.linalg.norm(recording.poses.velocities, axis=1).max() < 3.0


@pytest.mark.parametrize("inner", ["", "ouster_os1_128_mcap.mcap"])
def test_ouster(shared_datasets, inner):
    with open_recording(shared_datasets / "ouster_os1_128_mcap" / inner) as recording:
        assert len(recording.sweep_times) == 3 and recording.pose_topic == "/pose"
        for k in range(3):
            sweep = recording.sweep(k)
            assert len(sweep.points) > 100_000 and sweep.point_times is not None
            assert 0.09 < sweep.point_times.max() < 0.11


def test_sweeps_agree_in_the_world(shared_datasets):
    """Walls seen from two positions, 3 s apart, coincide in the world frame but not in the sensor's frame."""
    source = RecordingSource(open_recording(shared_datasets / "hilti_os0_A_mcap"), sweeps=1)
    clouds = []
    for k in (10, 16):
        source.seek(float(source.recording.sweep_times[k]))
        clouds.append(source.observe().points)
    raw = [source.recording.sweep(k).points for k in (10, 16)]
    source.close()
    assert median_distance(*clouds) < 0.25 * median_distance(*raw)


def median_distance(cloud, other):
    """Return the median distance [m] from points of one cloud to the nearest point of the other one."""
    return np.median([np.sqrt(((cloud - point) ** 2).sum(axis=1).min()) for point in other[::100]])
