"""Conversion to MCAP, read back with this project's reader, mcap's and rosbags'."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import bags
import captures
import numpy as np
import pytest
from command_line import run, run_json, run_refused
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from aero_viz.recordings import inspect, open_recording

Write = Callable[[list[bags.Item]], Path]


def changed(item: bags.Item, **fields: object) -> bags.Item:
    """Return a message with other values of some fields."""
    return dataclasses.replace(item, build=lambda store, ros1: dataclasses.replace(item.build(store, ros1), **fields))


def recorded(path: Path) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the points of all sweeps, and times and positions of the poses [n, 4]."""
    with open_recording(path) as recording:
        assert recording.poses is not None
        sweeps = [recording.sweep(i).points for i in range(len(recording.sweep_times))]
        return sweeps, np.column_stack([recording.poses.times, recording.poses.positions + recording.poses.offset])


def test_every_format_converts_to_the_same_sweeps_and_poses(
    written: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source = written([*bags.drive(), bags.text(0.05)])
    target = tmp_path / "converted.mcap"
    report = run_json(capsys, "convert", str(source), str(target))
    assert report["left_out"] == {} and report["topics"]["/points"] == 10
    for before, after in zip(recorded(source), recorded(target), strict=True):
        np.testing.assert_array_equal(np.concatenate(before), np.concatenate(after))


def test_the_file_opens_with_the_readers_of_mcap_and_rosbags(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source, target = mcap_of([*bags.drive(), bags.text(0.05)]), tmp_path / "converted.mcap"
    run_json(capsys, "convert", str(source), str(target))
    with target.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [
            (channel.topic, message.log_time, ros) for _, channel, message, ros in reader.iter_decoded_messages()
        ]
    clouds = [(time, cloud) for topic, time, cloud in decoded if topic == "/points"]
    assert [time for time, _ in clouds] == [bags.START + round(1e8 * k) for k in range(10)]
    assert clouds[0][1].width == 200
    with AnyReader([target]) as bag:
        kinds = {connection.topic: connection.msgtype for connection in bag.connections}
        assert kinds["/points"] == "sensor_msgs/msg/PointCloud2" and kinds["/odom"] == "nav_msgs/msg/Odometry"
        assert all(bag.deserialize(raw, connection.msgtype) for connection, _, raw in bag.messages())


def test_a_cut_keeps_stamps_and_drops_points_and_topics_as_asked(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source, target = mcap_of([*bags.drive(), bags.text(0.5)]), tmp_path / "cut.mcap"
    arguments = ("--start", "0.25", "--end", "0.65", "--topics", "/points", "/odom", "--decimate", "4")
    report = run_json(capsys, "convert", str(source), str(target), *arguments)
    assert report["topics"] == {"/points": 4, "/odom": 17}
    whole, cut = recorded(source), recorded(target)
    for k, points in enumerate(cut[0]):
        np.testing.assert_array_equal(points, whole[0][3 + k][::4])
    with open_recording(source) as before, open_recording(target) as after:
        assert after.start - before.start == 300_000_000


def test_livox_clouds_become_point_clouds_with_their_times(
    written: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    offsets = np.arange(50) * 2_000_000
    source = written([bags.odometry(0.0, (0, 0, 0)), bags.livox(0.0, bags.wall(50), offsets)])
    target = tmp_path / "converted.mcap"
    report = run_json(capsys, "convert", str(source), str(target))
    assert report["left_out"] == {} and "intensity and other values are left out" in report["notes"][0]
    with open_recording(target) as recording:
        sweep = recording.sweep(0)
    np.testing.assert_allclose(sweep.points, bags.wall(50), atol=1e-6)
    assert sweep.point_times is not None
    np.testing.assert_allclose(sweep.point_times, 1e-9 * offsets, atol=1e-7)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--topics", "/nothing"), "has no topic /nothing; it has /odom, /points"),
        (("--start", "5"), "is left to write: the recording lasts 0.9 s"),
        (("--start", "2", "--end", "1"), "--start 2 must be before --end 1"),
        (("--decimate", "0"), "--decimate must be at least 1, not 0"),
        (("--to", "rrd"), "out.mcap -o {folder}/out.rrd`."),
    ],
)
def test_mistakes_leave_no_file(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], message: str
):
    target = tmp_path / "out.mcap"
    source = mcap_of(bags.drive())
    error = run_refused(capsys, "convert", str(source), str(target), *arguments)
    assert message.format(folder=tmp_path) in error and error.endswith(".\n")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_recording_is_never_written_over_itself(mcap_of: Write, capsys: pytest.CaptureFixture[str]):
    source = mcap_of(bags.drive())
    before = source.read_bytes()
    for given in (source, source.parent):
        for flags in ((), ("--overwrite",)):
            assert "is the recording itself" in run_refused(capsys, "convert", str(given), str(source), *flags)
    assert source.read_bytes() == before


@pytest.mark.parametrize("count", [1, 3])
def test_the_first_message_is_written_whatever_its_nanoseconds_are(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str], count: int
):
    source = mcap_of([bags.cloud(0.1 * k + 200e-9, bags.xyz(bags.wall())) for k in range(count)])
    report = run_json(capsys, "convert", str(source), str(tmp_path / "out.mcap"))
    assert report["topics"] == {"/points": count}


@pytest.mark.parametrize("arguments", [("--start", "0.3", "--end", "0.6"), ("--topics", "/points", "/odom")])
def test_every_cut_has_the_mounting_of_the_sensor(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...]
):
    mounting = bags.transform(0.0, "base_link", "lidar", (0.2, 0, 0.3), (0, 0, 0, 1), topic="/tf_static")
    source, target = mcap_of([mounting, *bags.drive(child="base_link")]), tmp_path / "cut.mcap"
    report = run_json(capsys, "convert", str(source), str(target), *arguments)
    assert report["topics"]["/tf_static"] == 1
    with open_recording(source) as before, open_recording(target) as after:
        shift = round(1e-8 * (after.start - before.start))
        for k in range(len(after.sweep_times)):
            np.testing.assert_array_equal(after.sweep(k).points, before.sweep(k + shift).points)
    with target.open("rb") as file:
        times = [message.log_time for _, _, message in make_reader(file).iter_messages()]
    assert min(times) == bags.START + (300_000_000 if arguments[0] == "--start" else 0)


def test_the_mounting_alone_is_no_part_of_a_recording(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    mounting = bags.transform(0.0, "base_link", "lidar", (0.2, 0, 0.3), topic="/tf_static")
    source = mcap_of([mounting, *bags.drive(child="base_link")])
    error = run_refused(capsys, "convert", str(source), str(tmp_path / "cut.mcap"), "--start", "5")
    assert "is left to write: the recording lasts 0.9 s" in error


def test_clouds_of_one_row_are_thinned_whatever_their_row_step_is(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    items = [changed(bags.cloud(0.1 * k, bags.xyz(bags.wall())), row_step=7) for k in range(3)]
    source, target = mcap_of(items), tmp_path / "thin.mcap"
    report = run_json(capsys, "convert", str(source), str(target), "--decimate", "4")
    assert report["topics"] == {"/points": 3} and report["notes"] == []
    with open_recording(source) as before, open_recording(target) as after:
        np.testing.assert_array_equal(after.sweep(2).points, before.sweep(2).points[::4])


def test_damaged_files_of_a_folder_are_left_out_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clouds = tmp_path / "clouds"
    clouds.mkdir()
    for k in range(4):
        np.save(clouds / f"{k}.npy", bags.wall(seed=k))
    (clouds / "2.npy").write_bytes(b"")
    report = run_json(capsys, "convert", str(clouds), str(tmp_path / "out.mcap"))
    assert report["topics"] == {"/points": 3}
    assert (
        "points on /points have x, y, z and, if known, a time: intensity and other values are left out"
        in report["notes"]
    )
    assert any("1 of 4 messages on /points are left out" in note and "2.npy" in note for note in report["notes"])


def test_a_recording_of_damaged_messages_leaves_no_file(
    mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    source = mcap_of([changed(bags.cloud(0.0, bags.xyz(bags.wall())), width=1000)])
    error = run_refused(capsys, "convert", str(source), str(tmp_path / "out.mcap"), "--decimate", "2")
    assert "1 of 1 messages on /points are left out, because they cannot be read" in error


def test_what_is_missing_in_the_recording_is_said(mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source = mcap_of(bags.drive())
    source.write_bytes(source.read_bytes()[:-5000])
    target = tmp_path / "out.mcap"
    code, text, _ = run(capsys, "convert", str(source), str(target))
    assert code == 0 and "note: a.mcap is truncated" in text
    assert run_json(capsys, "convert", str(source), str(target), "--overwrite")["notes"] == list(
        inspect(source).problems
    )


def test_scans_are_written_whole(mcap_of: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source = mcap_of([captures.laser_scan(0.1 * k) for k in range(2)])
    report = run_json(capsys, "convert", str(source), str(tmp_path / "out.mcap"), "--decimate", "2")
    assert report["notes"] == ["scans on /scan are written whole: --decimate thins clouds only"]
