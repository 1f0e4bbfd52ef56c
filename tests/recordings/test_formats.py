"""Every format gives the same sweeps, poses and report."""

import dataclasses
import re
import struct

import bags
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from aero_viz.catalog import open_source
from aero_viz.errors import UserError
from aero_viz.reader_process import ReaderProcess
from aero_viz.recordings import inspect, open_recording


def test_report_of_every_format(written):
    info = inspect(written([*bags.drive(), bags.text(0.95)]))
    assert info.sweeps == 10 and info.poses == 37 and info.problems == ()
    assert info.duration_s == pytest.approx(0.95)
    assert [dataclasses.asdict(topic) for topic in info.topics] == [
        {"name": "/note", "type": "std_msgs/msg/String", "count": 1},
        {"name": "/odom", "type": "nav_msgs/msg/Odometry", "count": 37},
        {"name": "/points", "type": "sensor_msgs/msg/PointCloud2", "count": 10},
    ]
    assert info.points_per_sweep is not None and info.points_per_sweep.median == 200


def test_every_format_opens_in_a_reader_process(written):
    path = str(written(bags.drive()))
    here, there = open_source(path, seed=0), open_source(path, seed=0, read=ReaderProcess())
    assert here.info.times is not None
    np.testing.assert_array_equal(there.info.times, here.info.times)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("mcap-zstd", "mcap"),
        ("rosbag2-mcap", "rosbag2-mcap"),
        ("rosbag2-sqlite3", "rosbag2-sqlite3"),
        ("db3", "rosbag2-sqlite3"),
        ("rosbag1-lz4", "rosbag1"),
    ],
)
def test_format_name(tmp_path, name, expected):
    assert inspect(bags.FORMATS[name](tmp_path, bags.drive())).format == expected


def test_a_bag_that_is_being_recorded_plays_up_to_its_last_whole_message(tmp_path):
    raw = bytearray(bags.write_ros1(tmp_path / "a.bag", bags.drive()).read_bytes())
    first = 13  # behind "#ROSBAG V2.0"
    header = first + 4 + struct.unpack_from("<I", raw, first)[0]
    chunk = header + 4 + struct.unpack_from("<I", raw, header)[0]
    header = chunk + 4 + struct.unpack_from("<I", raw, chunk)[0]
    end = header + 4 + struct.unpack_from("<I", raw, header)[0]
    # `rosbag record` writes the place of the index and the length of a chunk when these are complete.
    for at, length in ((raw.index(b"index_pos=") + 10, 8), (raw.index(b"size=", chunk) + 5, 4), (header, 4)):
        raw[at : at + length] = bytes(length)
    path = tmp_path / "flight.bag.active"
    path.write_bytes(raw[: end - 3000])
    info = inspect(path)
    assert info.format == "rosbag1" and info.sweeps == 9
    assert any("`rosbag reindex` repairs it" in problem for problem in info.problems)
    with open_recording(path) as recording:
        assert all(len(recording.sweep(k).points) == 200 for k in range(9))


@pytest.mark.parametrize("compression", ["NONE", "ZSTD", "LZ4"])
def test_truncated_mcap_plays_up_to_the_cut(tmp_path, compression):
    whole = bags.write_mcap(tmp_path / "a.mcap", bags.drive(), compression=CompressionType[compression])
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    info = inspect(whole)
    assert 2 <= info.sweeps < 10
    problem = f"a.mcap is truncated: {sum(topic.count for topic in info.topics)} messages precede the cut"
    assert problem in info.problems
    with open_recording(whole) as recording:
        assert all(len(recording.sweep(k).points) == 200 for k in range(info.sweeps))


@pytest.mark.parametrize("compression", [None, "lz4"])
def test_truncated_ros1_bag_plays_up_to_the_cut(tmp_path, compression):
    # Enough sweeps for several of the chunks of 1 MiB that rosbags writes.
    points = np.tile(bags.wall(20_000), (1, 1))
    items = [bags.cloud(0.1 * k, bags.xyz(points)) for k in range(20)]
    path = bags.write_ros1(tmp_path / "a.bag", items, compression)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    info = inspect(path)
    assert 4 <= info.sweeps < 20
    problem = f"a.bag is truncated: {info.topics[0].count} messages precede the cut"
    assert problem in info.problems


def test_file_cut_before_its_first_message_is_refused(tmp_path):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.drive())
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(UserError, match=r"a.mcap is truncated: no messages precede the cut; record or copy"):
        inspect(path)


def test_unindexed_ros1_bag_plays_and_suggests_a_repair(tmp_path):
    path = bags.write_ros1(tmp_path / "a.bag", bags.drive())
    raw = bytearray(path.read_bytes())
    at = raw.index(b"index_pos=") + len(b"index_pos=")
    raw[at : at + 8] = bytes(8)
    path.write_bytes(raw)
    info = inspect(path)
    assert info.sweeps == 10
    assert any("rosbag reindex" in problem for problem in info.problems)


@pytest.mark.parametrize("which", [0, 1])
def test_damaged_chunk_loses_only_its_messages(tmp_path, which):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.drive())
    raw = bytearray(path.read_bytes())
    at = [match.end() for match in re.finditer(b"zstd", raw)][which] + 100
    raw[at : at + 50] = bytes(50)
    path.write_bytes(raw)
    info = inspect(path)
    assert 5 <= info.sweeps < 10
    assert "1 damaged records or chunks of a.mcap are left out" in info.problems


@pytest.mark.parametrize(("compression", "sweeps"), [("NONE", {10}), ("ZSTD", {5, 6, 7, 8, 9})])
def test_wrong_length_of_a_chunk_loses_at_most_that_chunk(tmp_path, compression, sweeps):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.drive(), compression=CompressionType[compression])
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = summary.chunk_indexes
    raw = bytearray(path.read_bytes())
    raw[chunks[0].chunk_start_offset + 8] = 255  # the most significant byte of the length
    path.write_bytes(raw)
    info = inspect(path)
    assert len(chunks) > 1 and info.sweeps in sweeps
    assert any("to the next chunk" in problem for problem in info.problems)


def test_damaged_message_in_the_middle_is_counted(mcap_of):
    broken = bags.cloud(0.45, bags.xyz(bags.wall()))
    build = broken.build
    broken.build = lambda store, ros1: _shortened(build(store, ros1))
    info = inspect(mcap_of([*bags.drive(), broken]))
    assert info.sweeps == 10
    assert any(problem.startswith("1 of 11 messages on /points are left out") for problem in info.problems)


def _shortened(message):
    message.data = message.data[:100]
    return message


def test_folder_without_metadata_plays(tmp_path):
    path = bags.write_ros2(tmp_path / "bag", bags.drive(), "sqlite3")
    (path / "metadata.yaml").unlink()
    info = inspect(path)
    assert info.sweeps == 10 and info.format == "rosbag2-sqlite3"
    assert any("metadata.yaml" in problem for problem in info.problems)


def test_folder_of_several_files_is_one_recording(tmp_path):
    items = bags.drive()
    folder = tmp_path / "bag"
    folder.mkdir()
    for part in range(3):
        bags.write_mcap(folder / f"bag_{part}.mcap", items[part::3])
    names = "".join(f"    - bag_{part}.mcap\n" for part in range(3))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}")
    assert inspect(folder).sweeps == 10


def test_topics_are_reported_even_if_none_can_be_decoded(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("foxglove.SceneUpdate", "protobuf", b"")
        channel = writer.register_channel("/cloud", "protobuf", schema)
        writer.add_message(channel, 0, b"abc", 0)
        writer.finish()
    info = inspect(path)
    assert [topic.type for topic in info.topics] == ["foxglove.SceneUpdate"] and info.sweeps == 0
    with pytest.raises(UserError, match=r"/cloud \(foxglove.SceneUpdate\)"):
        open_recording(path)
