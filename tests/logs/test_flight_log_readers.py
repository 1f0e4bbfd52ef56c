"""Flight logs read by other libraries, complete and truncated."""

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from aero_planner import PlannerConfig
from aero_planner.config.file import load_config
from aero_planner.onboard.ros_definitions import PLAN, PLAN_DEFINITION
from aero_viz.cli import main
from aero_viz.evaluation.score import load_trajectory, score
from aero_viz.flight import FlightResult, FlightRules, VehicleModel, fly
from aero_viz.flight.flight_settings import FlightSettings
from aero_viz.logs import flight_recorder
from aero_viz.logs.comparison import LoggedFlight
from aero_viz.logs.log_contents import is_flight_log, read_log
from aero_viz.recordings import inspect
from aero_viz.scenes import World, scene
from aero_viz.sensors import LidarModel

CONFIG = PlannerConfig().replace({"sampling.samples": 8})
KINDS = {
    "/odometry": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/sweep": "sensor_msgs/msg/PointCloud2",
    "/goal": "geometry_msgs/msg/PoseStamped",
    "/plan": "aero_viz_msgs/msg/Plan",
    "/plan/best": "nav_msgs/msg/Path",
    "/plan/guides": "visualization_msgs/msg/MarkerArray",
    "/plan/rollouts": "visualization_msgs/msg/MarkerArray",
}
"""Types that Foxglove, RViz and PlotJuggler know by name, and the plan."""


@pytest.fixture(scope="module")
def world() -> World:
    return scene("wall", seed=1)


@pytest.fixture(scope="module")
def flown(world: World, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FlightResult]:
    """Return the log of a flight with five ticks per plan, and its result."""
    path = tmp_path_factory.mktemp("log") / "flight.mcap"
    rules = FlightRules(ticks_per_plan=5, arrival_radius=0.5)
    lidar = LidarModel("small", points_per_sweep=1000)
    vehicle = VehicleModel(rate_lag=0.02, latency=0.01)
    options: dict[str, Any] = {"config": CONFIG, "seed": 4, "lidar": lidar, "speed": 2.0, "rules": rules}
    return path, fly(world, recorder=flight_recorder(path), vehicle=vehicle, **options)


def raw(path: Path) -> list[tuple[Any, Any, Any]]:
    with path.open("rb") as file:
        return list(make_reader(file, validate_crcs=True).iter_messages())


def test_channels_are_named_as_foxglove_and_rviz_expect(flown: tuple[Path, FlightResult]):
    with flown[0].open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert {topic: summary.schemas[channel.schema_id].name for topic, channel in channels.items()} == KINDS
    assert {channel.message_encoding for channel in channels.values()} == {"cdr"}
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}


@pytest.mark.parametrize("release", [Stores.ROS2_FOXY, Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_embedded_definitions_are_those_of_ros(flown: tuple[Path, FlightResult], release: Stores):
    """A ROS 2 machine ignores the embedded definitions and decodes with its own types: they must be equal."""
    ros = get_typestore(release)
    ros.register(get_types_from_msg(PLAN_DEFINITION, PLAN))
    markers_grew = release is Stores.ROS2_FOXY  # Galactic gave markers textures and meshes
    for schema, *_ in raw(flown[0]):
        embedded = get_types_from_msg(schema.data.decode(), schema.name)
        for name, (_, fields) in embedded.items():
            if not (markers_grew and "visualization_msgs" in name) and not (markers_grew and name.endswith("MeshFile")):
                assert ros.fielddefs[name][1] == fields, name


def test_rosbags_decodes_every_message_by_the_definitions_in_the_file(flown: tuple[Path, FlightResult]):
    store = get_typestore(Stores.EMPTY)
    counts: Counter[str] = Counter()
    for schema, channel, message in raw(flown[0]):
        if schema.name not in store.fielddefs:
            types = get_types_from_msg(schema.data.decode(), schema.name)
            store.register({name: kind for name, kind in types.items() if name not in store.fielddefs})
        decoded: Any = store.deserialize_cdr(message.data, schema.name)
        assert bytes(store.serialize_cdr(decoded, schema.name)) == message.data
        for header in stamped(decoded):
            assert header.frame_id in ("world", "body")
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == message.log_time
        counts[channel.topic] += 1
    plans = counts["/plan"]
    assert set(counts) == set(KINDS) and counts["/goal"] == 1
    assert {counts[topic] for topic in KINDS if topic.startswith("/plan")} == {plans}
    assert counts["/odometry"] == counts["/tf"] == round(flown[1].flight_time_s / 0.02) + 1
    assert plans == -(-(counts["/odometry"] - 1) // 5) + 1


def stamped(message: Any) -> list[Any]:
    """Return the headers in a message."""
    if hasattr(message, "header"):
        return [message.header]
    items = getattr(message, "transforms", None) or getattr(message, "markers", None) or []
    return [item.header for item in items]


def test_mcap_ros2_decodes_every_message(flown: tuple[Path, FlightResult]):
    with flown[0].open("rb") as file:
        decoded = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(decoded) == len(raw(flown[0]))
    rates = [ros.twist.twist.angular for _, channel, _, ros in decoded if channel.topic == "/odometry"]
    turns = [ros.pose.pose.orientation for _, channel, _, ros in decoded if channel.topic == "/odometry"]
    assert (rates[0].x, rates[0].y, rates[0].z) == (0.0, 0.0, 0.0)
    # Turning by the rates for a tick leads from each attitude to the next.
    for before, rate, after in zip(turns, rates[1:], turns[1:], strict=False):
        q, half = np.array([before.w, before.x, before.y, before.z]), 0.01 * np.array([rate.x, rate.y, rate.z])
        angle = np.linalg.norm(half)
        w, v = np.cos(angle), half * np.sinc(angle / np.pi)
        turned = np.array([q[0] * w - q[1:] @ v, *(q[0] * v + w * q[1:] + np.cross(q[1:], v))])
        np.testing.assert_allclose(turned, [after.w, after.x, after.y, after.z], atol=1e-6)


def test_attachments_repeat_the_flight(flown: tuple[Path, FlightResult], world: World, tmp_path: Path):
    path, result = flown
    with path.open("rb") as file:
        attached = {item.name: item.data.decode() for item in make_reader(file).iter_attachments()}
    assert set(attached) == {"world.json", "flight.json", "config_0.yaml"}
    (tmp_path / "config.yaml").write_text(attached["config_0.yaml"])
    settings = FlightSettings.from_dict(json.loads(attached["flight.json"]))
    repeated = fly(
        World.from_dict(json.loads(attached["world.json"])),
        recorder=flight_recorder(tmp_path / "again.mcap"),
        config=load_config(tmp_path / "config.yaml"),
        seed=settings.seed,
        device=settings.device,
        lidar=settings.lidar,
        vehicle=settings.drone,
        rules=settings.rules,
    )
    assert (repeated.reason, repeated.smoothness, repeated.length_m) == (
        result.reason,
        result.smoothness,
        result.length_m,
    )


def test_score_reads_the_log_as_it_was_flown(flown: tuple[Path, FlightResult], world: World):
    path, result = flown
    scored = score(load_trajectory(path), world, rules=FlightRules(arrival_radius=0.5))
    assert scored.reason == result.reason
    for name in ("flight_time_s", "length_m", "mean_speed", "max_speed", "smoothness", "min_clearance"):
        assert getattr(scored, name) == pytest.approx(getattr(result, name), rel=1e-4), name


def test_killed_while_flying_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """After kill -9 of the real program, the flight up to the last chunk and all attachments are there."""
    path, csv_path = tmp_path / "flight.mcap", tmp_path / "flight.csv"
    command = [sys.executable, "-m", "aero_viz", "fly", "forest", "--count", "20", "--seed", "2", "--speed", "2"]
    command += ["--sampling.samples", "8", "--log", str(path), "--trajectory", str(csv_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        while not (path.exists() and path.stat().st_size > 1_500_000):
            assert process.poll() is None, process.stderr.read() if process.stderr else ""
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
    finally:
        process.kill()
        process.communicate()
    info = inspect(path)
    assert any("truncated" in problem for problem in info.problems) and info.sweeps > 10 and info.poses > 25
    with path.open("rb") as file:
        names = set()
        try:
            for record in StreamReader(file, record_size_limit=None).records:
                if isinstance(record, Attachment):
                    names.add(record.name)
        except Exception as error:  # the end of a torn file
            assert "EndOfFile" in type(error).__name__ or isinstance(error, EOFError), error
    assert names == {"world.json", "flight.json", "config_0.yaml"}
    assert is_flight_log(path)
    contents = read_log(path)
    assert contents.world() is not None and contents.config() is not None
    assert len(contents.plans) > 25 and len(LoggedFlight.read(path).columns["time"]) > 25

    main(["score", str(path), "--world", "forest", "--count", "20", "--seed", "2", "--json"])
    scored = json.loads(capsys.readouterr().out)
    assert scored["reason"] is None and scored["explanation"].startswith("The flight was not over after")
    flown_so_far = load_trajectory(csv_path)
    logged = load_trajectory(path)
    assert 0.4 < scored["flight_time_s"] <= flown_so_far.times[-1] + 1e-6
    expected, _ = flown_so_far.at(logged.times - logged.times[0])
    np.testing.assert_allclose(logged.positions, expected, atol=2e-6)
