"""The recordings that ship with the package."""

import json
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from aero_planner import PlanStatus
from aero_viz.catalog import open_source, shipped_recordings
from aero_viz.logs.sensor_log import SensorLogOptions, write_sensor_log
from aero_viz.recordings import open_recording
from aero_viz.scenes import scene
from aero_viz.session import Session


def test_shipped_recordings_play_with_poses_and_are_small():
    shipped = shipped_recordings()
    assert list(shipped) == ["forest_mid360", "room_mid360"]
    assert sum(path.stat().st_size for path, _ in shipped.values()) < 300_000
    for path, _ in shipped.values():
        session = Session(open_source(str(path)))
        assert all(session.tick().plan.status == PlanStatus.OK for _ in range(3))
        session.close()


def test_the_forest_flight_arrives_and_holds_plan_and_goal():
    path, _ = shipped_recordings()["forest_mid360"]
    with path.open("rb") as file:
        reader = make_reader(file)
        outcome = next(json.loads(a.data) for a in reader.iter_attachments() if a.name == "outcome.json")
        summary = reader.get_summary()
    assert outcome["reason"] == "arrived"
    assert summary is not None
    topics = {channel.topic for channel in summary.channels.values()}
    assert {"/sweep", "/odometry", "/plan", "/plan/best", "/goal"} <= topics


def test_a_sensor_log_is_reproducible_and_its_sweeps_fit_its_poses(tmp_path: Path):
    options = SensorLogOptions(every=7, imu=True, duration=0.5)
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    for path in (first, second):
        write_sensor_log(scene("pillars", seed=2), path, seed=5, options=options)
    assert first.read_bytes() == second.read_bytes()
    with open_recording(first) as recording:
        assert recording.poses is not None
        sweep = recording.sweep(4)
        assert sweep.point_times is not None
        placed, known = recording.poses.track.deskew(sweep.points, sweep.time + sweep.point_times.astype(float))
        assert known.all()
        world = placed + recording.poses.offset
        distance = np.abs(scene("pillars", seed=2).distance(world))
        assert np.median(distance) < 0.03  # the noise of the range
