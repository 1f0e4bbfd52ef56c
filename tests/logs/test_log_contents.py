"""Damaged and hostile flight logs."""

import json
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore
from small_source import small_config, small_source

from aero_viz.catalog import open_source
from aero_viz.cli import main
from aero_viz.errors import UserError
from aero_viz.explain.trace import trace_of_log
from aero_viz.logs import flight_recorder
from aero_viz.logs.comparison import LoggedFlight, compare_logs
from aero_viz.logs.log_contents import read_log
from aero_viz.logs.replay import FlightReplay
from aero_viz.session import Session


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of half a second."""
    path = tmp_path_factory.mktemp("log") / "whole.mcap"
    session = Session(small_source(), config=small_config())
    with flight_recorder(path) as log:
        for _ in range(8):
            log.write(session.tick())
    session.close()
    return path


def test_the_process_that_reads_a_log_imports_neither_planner_nor_session():
    code = "import sys, aero_viz.logs.log_contents; print({'warp', 'scipy', 'aero_viz.session'} & sys.modules.keys())"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert result.stdout == "set()\n"


def rewrite(
    whole: Path,
    path: Path,
    *,
    attachments: dict[str, bytes] | None = None,
    outcome: str = "",
    change: Callable[[str, bytes], bytes] = lambda topic, data: data,
) -> Path:
    """Write a log with other attachments, another outcome or other messages, all of it valid MCAP."""
    with whole.open("rb") as source, path.open("wb") as target:
        reader, writer = make_reader(source), Writer(target, compression=CompressionType.NONE)
        writer.start()
        for entry in reader.iter_attachments():
            data = (attachments or {}).get(entry.name, entry.data)
            writer.add_attachment(0, 0, entry.name, entry.media_type, data)
        if outcome:
            writer.add_metadata("flight_log", {"outcome": outcome})
        channels: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data = change(channel.topic, message.data)
            writer.add_message(channels[channel.topic], message.log_time, data, message.publish_time)
        writer.finish()
    return path


def replay(path: Path) -> Any:
    source = open_source(str(path))
    assert isinstance(source, FlightReplay)
    for _ in range(5):
        source.observe()
        source.advance()
    source.close()
    return source


@pytest.mark.parametrize(
    ("attachments", "complaint"),
    [
        ({"world.json": b"{"}, "world.json in .* is damaged"),
        ({"world.json": b"[" * 100_000}, "world.json in .* is damaged"),
        ({"world.json": b"[1]"}, "The world in .* is damaged"),
        ({"flight.json": b"[1]"}, "The settings of the flight in .* are damaged"),
        ({"flight.json": json.dumps({"rules": {"period": -1}}).encode()}, "The settings of the flight in .* damaged"),
        ({"flight.json": json.dumps({"lidar": {"a": 1}}).encode()}, "The settings of the flight in .* are damaged"),
    ],
)
def test_a_log_with_a_damaged_attachment_plays_without_it_and_says_so(whole, tmp_path, attachments, complaint):
    path = rewrite(whole, tmp_path / "a.mcap", attachments=attachments)
    notices = " ".join(replay(path).info.notices)
    assert "Recorded flight" in notices
    with pytest.raises(UserError, match=complaint) as raised:
        compare_logs(path, path)
    assert str(raised.value) in notices


@pytest.fixture(scope="module")
def cut(whole: Path) -> Path:
    """The log as kill -9 leaves it: all chunks, and the beginning of the next record."""
    path = whole.with_name("cut.mcap")
    with whole.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        last = max(summary.chunk_indexes, key=lambda chunk: chunk.chunk_start_offset)
    path.write_bytes(whole.read_bytes()[: last.chunk_start_offset + last.chunk_length + 12])
    return path


def test_a_log_that_was_cut_off_holds_all_that_was_written(whole: Path, cut: Path):
    a, b = read_log(whole), read_log(cut)
    assert len(b.plans) == len(a.plans) == 8 and b.attachments == a.attachments and b.pose_stamps == a.pose_stamps
    assert replay(cut).info.recorded_plan is not None
    assert compare_logs(whole, cut).differs_at is None


def test_a_log_that_was_cut_off_is_explained(cut: Path):
    trace = trace_of_log(cut)
    assert len(trace.frames) == 8 and any("it was cut off" in sentence for sentence in trace.missing)


def test_a_log_that_was_cut_before_its_first_plan_is_no_flight_log(cut: Path, tmp_path: Path):
    path = tmp_path / "early.mcap"
    path.write_bytes(cut.read_bytes()[:300])
    with pytest.raises(UserError, match="is not a flight log"):
        compare_logs(path, path)


def test_plans_with_impossible_numbers_are_left_out_and_counted(whole, tmp_path):
    count = 0

    def change(topic: str, data: bytes) -> bytes:
        nonlocal count
        count += topic == "/plan"
        if topic != "/plan" or count > 3:
            return data
        kinds = replay(whole).info.recorded_plan(1e3).kinds
        best = data.index(kinds[-1].encode() + b"\0") + len(kinds[-1]) + 1
        best += -(best - 4) % 4  # aligned, after the 4 bytes of the encapsulation
        return data[:best] + struct.pack("<i", 1 << 30) + data[best + 4 :]

    source = replay(rewrite(whole, tmp_path / "a.mcap", change=change))
    assert "3 goals, plans and poses of the log have impossible numbers: left out." in source.info.notices


def test_poses_with_impossible_numbers_are_left_out_of_a_comparison(whole, tmp_path):
    store, name, count = get_typestore(Stores.ROS2_HUMBLE), "nav_msgs/msg/Odometry", 0

    def change(topic: str, data: bytes) -> bytes:
        nonlocal count
        count += topic == "/odometry"
        if topic != "/odometry" or count != 4:
            return data
        message: Any = store.deserialize_cdr(data, name)
        message.pose.pose.position.x = np.nan
        return bytes(store.serialize_cdr(message, name))

    flight = LoggedFlight.read(rewrite(whole, tmp_path / "a.mcap", change=change))
    assert all(np.isfinite(column).all() for column in flight.columns.values())


def test_a_log_that_expands_to_gigabytes_is_played_without_its_plans(whole, tmp_path):
    path = tmp_path / "bomb.mcap"
    rewrite(whole, path, attachments={"flight.json": b"{}"})
    data = bytearray(path.read_bytes())
    at = data.index(b"flight.json")  # the attachment claims 4 TB
    start = data.rindex(b"\x09", 0, at - 19)
    data[start + 1 : start + 9] = (1 << 42).to_bytes(8, "little")
    path.write_bytes(data)
    notices = " ".join(replay(path).info.notices)
    assert "bomb.mcap cannot be read as a flight log: RecordLengthLimitExceeded" in notices


def test_the_texts_of_a_log_do_not_reach_the_terminal_as_commands(whole, tmp_path, capsys, monkeypatch):
    hostile = rewrite(
        whole, tmp_path / "a.mcap", outcome="\x1b]0;owned\x07", attachments={"flight.json": b'{"x": "\\u001b[2J"}'}
    )
    monkeypatch.setattr("sys.argv", ["aero-viz", "compare", str(hostile), str(whole)])
    main()
    printed = capsys.readouterr().out
    assert "?]0;owned?" in printed and "?[2J" in printed and "\x1b" not in printed
