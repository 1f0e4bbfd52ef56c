"""Small files that expand to gigabytes or never end, files that shrink or are none, and damage without a trace."""

import bz2
import os
import sqlite3
import struct
import subprocess
import sys
from pathlib import Path

import bags
import captures
import numpy as np
import pytest
import zstandard
from fuzz.worker import Worker
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from aero_viz.errors import UserError
from aero_viz.recordings import RecordingSource, inspect, open_recording

MIB = 1 << 20


def record(opcode: int, content: bytes) -> bytes:
    """Return an MCAP record."""
    return struct.pack("<BQ", opcode, len(content)) + content


def mcap(*records: bytes) -> bytes:
    return b"\x89MCAP0\r\n" + record(1, struct.pack("<II", 0, 0)) + b"".join(records)


def mcap_chunk(raw: bytes) -> bytes:
    packed = zstandard.ZstdCompressor().compress(raw)
    header = struct.pack("<QQQII", 0, 0, len(raw), 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
    return record(6, header + packed)


def ros1_record(header: dict[bytes, bytes], content: bytes) -> bytes:
    fields = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k + b"=" + v for k, v in header.items())
    return struct.pack("<I", len(fields)) + fields + struct.pack("<I", len(content)) + content


def ros1_bomb() -> bytes:
    size = 200 * MIB
    chunk = ros1_record(
        {b"op": b"\5", b"compression": b"bz2", b"size": struct.pack("<I", size)}, bz2.compress(bytes(size))
    )
    return b"#ROSBAG V2.0\n" + ros1_record({b"op": b"\3", b"index_pos": bytes(8)}, b"") + 20 * chunk


def index_bomb() -> bytes:
    """Return an MCAP file whose index has 60 000 chunks, each of them a record with a wrong length."""
    data = mcap(*(struct.pack("<BQ", 3, 1 << 60) for _ in range(60_000)))
    index = b"".join(record(8, struct.pack("<QQQ", 0, 0, 20 + 9 * i) + bytes(40)) for i in range(60_000))
    return data + index + record(2, struct.pack("<QQI", len(data), 0, 0)) + b"\x89MCAP0\r\n"


BOMBS = {
    "chunks.mcap": (lambda: mcap(*[mcap_chunk(bytes(200 * MIB))] * 32), "compressed more than 100 times"),
    "chunk.mcap": (lambda: mcap(mcap_chunk(bytes(512 * MIB))), "compressed more than 100 times"),
    "empties.mcap": (lambda: mcap(mcap_chunk(record(0x85, b"") * 7_000_000)), "too costly to read"),
    "index.mcap": (index_bomb, "damaged"),
    "a.bag": (ros1_bomb, "compressed more than 100 times"),
    "a.db3.zstd": (
        lambda: zstandard.ZstdCompressor().compress(b"SQLite format 3\0" + bytes(1024 * MIB)),
        "expands to more than",
    ),
}


@pytest.fixture(scope="module")
def worker():
    with Worker() as child:
        yield child


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_costs_little(worker, tmp_path, name):
    make, expected = BOMBS[name]
    (tmp_path / name).write_bytes(make())
    outcome = worker.run("recording", tmp_path / name)
    assert outcome.kind == "refused" and expected in outcome.text and name in outcome.text
    assert outcome.memory < 600 * MIB


@pytest.mark.parametrize(
    ("write", "expected"),
    [
        (
            lambda folder: next(bags.write_ros2(folder, bags.drive(), "sqlite3", "file").glob("*.zstd")),
            r"\.db3\.zstd expands to more than the 0 MiB",
        ),
        (
            lambda folder: captures.write_lvx2(folder.with_suffix(".lvx2"), captures.livox_packets(3)),
            r"a\.lvx2 takes more than the 0 MiB",
        ),
    ],
)
def test_the_temporary_folder_is_not_filled(tmp_path, monkeypatch, write, expected):
    path = write(tmp_path / "a")
    usage = type("Usage", (), {"free": 20_000})
    monkeypatch.setattr("shutil.disk_usage", lambda folder: usage)
    with pytest.raises(UserError, match=rf"{expected} that may be used in .*TMPDIR"):
        inspect(path)


def database(path: Path, messages: str) -> Path:
    with sqlite3.connect(path) as connection:
        connection.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        connection.execute("INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr')")
        connection.execute(messages)
    connection.close()
    return path


ENDLESS = (
    "WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r) "
    "SELECT id, 1 AS topic_id, id AS timestamp, zeroblob(10) AS data FROM r"
)


@pytest.mark.parametrize(
    ("messages", "expected"),
    [
        (f"CREATE VIEW messages AS {ENDLESS}", "has no plain table 'messages'"),
        ("CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)", "has no plain table 'messages'"),
        (
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(900000000)))",
            "lacks the plain column 'data'",
        ),
    ],
)
def test_a_database_that_computes_its_content_is_refused(worker, tmp_path, messages, expected):
    outcome = worker.run("recording", database(tmp_path / "a.db3", messages))
    assert outcome.kind == "refused" and expected in outcome.text


def test_an_error_of_sqlite_is_one_line(tmp_path):
    path = database(tmp_path / "a.db3", "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
    with sqlite3.connect(path) as connection:
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = 'CREATE', name = 'a' || char(10) || 'b'")
    connection.close()
    with pytest.raises(UserError, match=r"malformed database schema \(a b\)") as caught:
        inspect(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        "a: &a [x, x, x, x, x, x, x, x, x]\n"
        + "".join(f"{c}: &{c} [{', '.join([f'*{p}'] * 9)}]\n" for p, c in zip("abcdefgh", "bcdefghi", strict=True))
        + "rosbag2_bagfile_information: {relative_file_paths: *i}",
        "rosbag2_bagfile_information: {relative_file_paths: [{a: b}]}",
        "rosbag2_bagfile_information: {relative_file_paths: [1, 2]}",
        "rosbag2_bagfile_information: {relative_file_paths: [!!python/object/apply:os.abort []]}",
        "rosbag2_bagfile_information: &a {relative_file_paths: *a}",
        "[" * 100_000,
        "{nonsense: [",
        "x" * (2 * MIB),
    ],
)
def test_metadata_of_anything_but_file_names_is_refused(worker, tmp_path, content):
    folder = bags.write_ros2(tmp_path / "bag", bags.drive(2), "mcap")
    (folder / "metadata.yaml").write_text(content)
    outcome = worker.run("recording", folder)
    assert outcome.kind == "refused" and "metadata.yaml is damaged" in outcome.text and len(outcome.text) < 300


def test_a_file_that_metadata_names_twice_plays_once(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    bags.write_mcap(folder / "a.mcap", bags.drive())
    names = "[a.mcap, ./a.mcap, ../bag/a.mcap]"
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information: {{relative_file_paths: {names}}}")
    assert inspect(folder).sweeps == 10


@pytest.mark.parametrize("name", ["mcap-zstd", "mcap-plain", "mcap-unchunked", "rosbag1", "db3"])
def test_a_file_that_shrinks_while_it_plays_loses_sweeps_only(tmp_path, name):
    path = bags.FORMATS[name](tmp_path, [bags.cloud(0.1 * k, bags.xyz(bags.wall(20_000, k))) for k in range(8)])
    code = (
        "import os, sys; from aero_viz.recordings import open_recording; path = sys.argv[1]; r = open_recording(path);"
        "os.truncate(path, 20_000); print([len(r.sweep(k).points) for k in range(8)], r.damage)"
    )
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "0]" in done.stdout and "could not be read" in done.stdout


@pytest.mark.filterwarnings("error")
def test_clouds_of_a_folder_that_change_or_are_no_files_are_lost_alone(tmp_path):
    for k in range(6):
        np.full((50, 4), 1.5, "<f4").tofile(tmp_path / f"{k}.bin")
    (tmp_path / "1.bin").unlink()
    os.mkfifo(tmp_path / "1.bin")
    with open_recording(tmp_path) as recording:
        os.truncate(tmp_path / "2.bin", 163)
        (tmp_path / "3.bin").unlink()
        (tmp_path / "4.bin").write_bytes(np.random.default_rng(0).bytes(80_000))
        counts = [len(recording.sweep(k).points) for k in range(6)]
        assert counts == [50, 0, 0, 0, 0, 50]
        assert (
            recording.damage and "4 of 6 sweeps could not be read and played without points: 1..4" in recording.damage
        )


@pytest.mark.parametrize("kind", ["pipe", "device", "socket"])
def test_only_regular_files_are_opened(tmp_path, kind):
    import socket

    path = tmp_path / "a.mcap"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        socket.socket(socket.AF_UNIX).bind(str(path))
    with pytest.raises(UserError, match=rf"a\.mcap cannot be read: it is a {kind}, not a regular file\.$"):
        inspect(path)


def test_a_damaged_compressed_file_is_named_itself(tmp_path):
    path = next(bags.write_ros2(tmp_path / "bag", bags.drive(), "sqlite3", "file").glob("*.zstd"))
    content = path.read_bytes()
    for length in (5, 100, len(content) // 2, len(content) - 3):
        path.write_bytes(content[:length])
        try:
            problems = " ".join(inspect(path).problems)
        except UserError as error:
            problems = str(error)
        assert path.name in problems and "truncated" in problems and "aero-viz-" not in problems
    path.write_bytes(content[:20] + b"damage" + content[26:])
    with pytest.raises(UserError, match=r"\.db3\.zstd is damaged"):
        inspect(path)


def test_flipped_bits_of_uncompressed_chunks_are_found(tmp_path):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.drive(), compression=CompressionType.NONE)
    raw, random = path.read_bytes(), np.random.default_rng(0)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = summary.chunk_indexes
    for _ in range(60):
        chunk = chunks[random.integers(len(chunks))]
        at = chunk.chunk_start_offset + chunk.chunk_length - 1 - random.integers(chunk.uncompressed_size)
        flipped = bytearray(raw)
        flipped[at] ^= 1 << random.integers(8)
        path.write_bytes(flipped)
        info = inspect(path)
        assert "1 damaged records or chunks of a.mcap are left out" in info.problems
        assert any("messages that it counts are missing" in problem for problem in info.problems)
        assert info.sweeps < 10


def test_a_chunk_is_checked_again_when_it_plays(tmp_path):
    path = bags.write_mcap(tmp_path / "a.mcap", bags.drive(), compression=CompressionType.NONE)
    with open_recording(path) as recording:
        with path.open("r+b") as file:
            file.seek(path.stat().st_size // 2)
            file.write(b"\x55" * 64)
        assert min(len(recording.sweep(k).points) for k in range(10)) == 0
        assert recording.damage is not None and "could not be read" in recording.damage


def test_flipped_bits_of_messages_without_chunks_are_found(tmp_path):
    path, items = tmp_path / "a.mcap", bags.drive()
    store = bags.STORES[False]
    with path.open("wb") as file:
        writer, channels = Writer(file, use_chunking=False, enable_data_crcs=True), {}
        writer.start()
        for item in items:
            if item.topic not in channels:
                schema = writer.register_schema(item.type_name, "ros2msg", b"")
                channels[item.topic] = writer.register_channel(item.topic, "cdr", schema)
            raw = bytes(store.serialize_cdr(item.build(store, False), item.type_name))
            writer.add_message(channels[item.topic], item.time, raw, item.time)
        writer.finish()
    assert inspect(path).problems == ()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    assert any("the checksum of its content is wrong" in problem for problem in inspect(path).problems)


@pytest.mark.parametrize("name", ["mcap-unchunked", "rosbag1"])
def test_messages_that_disappear_are_counted(tmp_path, name):
    path = bags.FORMATS[name](tmp_path, bags.drive())
    raw = path.read_bytes()
    if name == "rosbag1":  # the kind of the chunk becomes one that is unknown
        raw = raw.replace(b"op=\x05", b"op=\x55", 1)
    else:
        with path.open("rb") as file:
            at = [message.data for _, _, message in make_reader(file).iter_messages()][20]
        start = raw.index(at) - 31
        raw = raw[:start] + b"\x85" + raw[start + 1 :]
    path.write_bytes(raw)
    try:
        problems = " ".join(inspect(path).problems)
    except UserError as error:
        problems = str(error)
    assert "messages that it" in problems and "missing" in problems


@pytest.mark.parametrize("twist", [(1e30, 0, 0), (0, np.inf, 0)])
def test_an_impossible_velocity_is_left_out_and_counted(mcap_of, twist):
    items = bags.drive()
    items[8] = bags.odometry(0.1501, [103.0, 50, 2], twist=twist)
    path = mcap_of(items)
    info = inspect(path)
    assert any("1 of 37 messages on /odom are left out" in p and "its velocity" in p for p in info.problems)
    source = RecordingSource(open_recording(path))
    while source.outcome is None:
        assert np.abs(np.asarray(source.observe().state.velocity)).max() < 10
        source.advance()
    source.close()


def test_poses_far_from_the_others_are_left_out_and_counted(mcap_of):
    items = bags.drive()
    items[0] = bags.odometry(0.0, [9e7, 50, 2])
    with open_recording(mcap_of(items)) as recording:
        assert recording.poses is not None and len(recording.poses.times) == 36
        assert any("1 of 37 poses on /odom are left out" in problem for problem in recording.problems)


def test_jumps_of_the_position_are_said(mcap_of):
    items = [bags.pose_stamped(0.1 * k, [5e4 * (k == 5), 0, 1]) for k in range(10)]
    items += [bags.cloud(0.1 * k, bags.xyz(bags.wall())) for k in range(10)]
    with open_recording(mcap_of(items)) as recording:
        assert recording.poses is not None and np.abs(recording.poses.velocities).max() < 1e3
        assert any("the positions on /pose jump" in problem for problem in recording.problems)


def test_thousands_of_topics_and_endless_names_cost_little(worker, tmp_path):
    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def message(number: int, topic: str) -> bytes:
        channel = struct.pack("<HH", number, 1) + text(topic) + text("cdr") + struct.pack("<I", 0)
        return record(4, channel) + record(5, struct.pack("<HIQQ", number, 0, 0, 0) + b"abcd")

    schema = record(3, struct.pack("<H", 1) + text("std_msgs/msg/String") + text("ros2msg") + struct.pack("<I", 0))
    path = tmp_path / "a.mcap"
    path.write_bytes(mcap(schema, mcap_chunk(b"".join(message(1, f"/topic{i}") for i in range(100_000)))))
    outcome = worker.run("recording", path)
    assert outcome.kind == "refused" and "and 1993 more" in outcome.text
    assert worker.run("report", path).kind == "done"
    path.write_bytes(mcap(schema, message(1, "/t" * 1_000_000)))
    assert worker.run("recording", path).kind == "refused"


def test_a_capture_that_expands_or_ends_early_says_so(worker, tmp_path):
    packages = b"".join(
        struct.pack("<BIBBQHBIB4x", 0, 7, 9, 0, i * 10**8, 0, 2, 8, 0) + bytes([1] * 8) for i in range(30_000)
    )
    head = b"livox_tech".ljust(16, b"\0") + bytes([2, 0, 0, 0]) + struct.pack("<IIB", 0xAC0EA767, 50, 0)
    content = head + struct.pack("<3Q", 0, 24 + len(packages), 0) + packages
    path = tmp_path / "a.lvx2"
    path.write_bytes(content)
    assert worker.run("recording", path).kind in ("done", "refused")
    path.write_bytes(content[: 29 + 24 + 100 * 35 + 5])
    assert any("is truncated: 99 messages precede the cut" in problem for problem in inspect(path).problems)
    path.write_bytes(content[: 29 + 24 + 100 * 35] + bytes([9] * 36))
    assert any("is damaged, a package claims" in problem for problem in inspect(path).problems)


def test_damaged_clouds_of_a_folder_play_without_points(tmp_path):
    for k in range(8):
        np.save(tmp_path / f"{k}.npy", bags.wall())
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 3), }\n"
    hostile = b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header
    for k in (0, 5):
        (tmp_path / f"{k}.npy").write_bytes(hostile)
    with open_recording(tmp_path) as recording:
        assert [len(recording.sweep(k).points) for k in range(8)] == [0, 200, 200, 200, 200, 0, 200, 200]
        assert recording.damage is not None and "2 of 8 sweeps could not be read" in recording.damage


@pytest.mark.parametrize(
    ("times", "message"), [("0\nnan\n", "not finite"), ("0\n1e300\n", "beyond 2038"), ("0\n", "1 times for 2 clouds")]
)
def test_impossible_times_of_clouds_are_refused(tmp_path, times, message):
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", bags.wall())
    (tmp_path / "times.txt").write_text(times)
    with pytest.raises(UserError, match=rf"times\.txt.*{message}"):
        open_recording(tmp_path)


def test_names_that_are_no_times_are_only_names(tmp_path):
    for name in ("inf", "1e300", "1e17"):
        np.save(tmp_path / f"{name}.npy", bags.wall())
    with open_recording(tmp_path) as recording:
        np.testing.assert_allclose(recording.sweep_times, [0.0, 0.1, 0.2])
