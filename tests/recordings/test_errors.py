"""Every problem with a file is reported in one sentence."""

import bags
import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from aero_viz.errors import UserError
from aero_viz.recordings import inspect, open_recording
from aero_viz.scenes.map_files import read_points


def test_missing_file_suggests_its_neighbours(tmp_path):
    bags.write_mcap(tmp_path / "flight_03.mcap", bags.drive(2))
    with pytest.raises(UserError, match=r"did you mean flight_03.mcap"):
        inspect(tmp_path / "flight_30.mcap")
    with pytest.raises(UserError, match=r"holds flight_03.mcap"):
        inspect(tmp_path / "zzz")
    with pytest.raises(UserError, match="nor does the folder"):
        inspect(tmp_path / "no" / "such.bag")


def test_folders_without_a_recording(tmp_path):
    with pytest.raises(UserError, match=r"folder without a recording.*MCAP"):
        inspect(tmp_path)
    bags.write_mcap(tmp_path / "one.mcap", bags.drive(2))
    bags.write_mcap(tmp_path / "two.mcap", bags.drive(2))
    with pytest.raises(UserError, match=r"choose one of one.mcap, two.mcap"):
        inspect(tmp_path)


def test_unknown_formats_list_the_supported_ones(tmp_path):
    (tmp_path / "a.txt").write_text("not a bag")
    with pytest.raises(UserError, match=r"MCAP files, rosbag2 folders .* ROS 1 .bag"):
        inspect(tmp_path / "a.txt")
    (tmp_path / "b.bag").write_bytes(b"")
    with pytest.raises(UserError, match="is empty"):
        inspect(tmp_path / "b.bag")
    (tmp_path / "c.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    with pytest.raises(UserError, match=r"old format .*`rosbag fix`"):
        inspect(tmp_path / "c.bag")


def test_damaged_metadata(tmp_path):
    path = bags.write_ros2(tmp_path / "bag", bags.drive(2), "mcap")
    (path / "metadata.yaml").write_text("{nonsense: [")
    with pytest.raises(UserError, match=r"metadata.yaml is damaged"):
        inspect(path)
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {relative_file_paths: [gone.mcap]}")
    with pytest.raises(UserError, match=r"lacks gone.mcap"):
        inspect(path)


def test_no_clouds(mcap_of):
    path = mcap_of([bags.odometry(0, [0, 0, 0]), bags.text(0.5)])
    with pytest.raises(UserError, match=r"no PointCloud2 topic .* /note \(std_msgs/msg/String\), /odom"):
        open_recording(path)
    info = inspect(path)
    assert info.sweeps == 0 and "no PointCloud2 topic" in info.problems[0]


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("ouster_ros/msg/PacketMsg", "driver makes while it replays the packets"),
        ("pandar_msgs/msg/PandarScan", "driver makes while it replays the packets"),
        ("rslidar_msgs/msg/rslidarScan", "driver makes while it replays the packets"),
        ("nebula_msgs/msg/NebulaPackets", "driver makes while it replays the packets"),
        ("point_cloud_interfaces/msg/CompressedPointCloud2", "point_cloud_transport republish"),
        ("sensor_msgs/msg/Image", "record the topic of the LiDAR, too"),
    ],
)
def test_points_in_other_forms_name_the_next_step(tmp_path, kind, advice):
    with (tmp_path / "os.mcap").open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", b"uint8[] buf")
        channel = writer.register_channel("/raw", "cdr", schema)
        writer.add_message(channel, bags.START, bytes(64), bags.START)
        writer.finish()
    with pytest.raises(UserError, match=f"os.mcap has no PointCloud2 .*: .*{advice}"):
        open_recording(tmp_path / "os.mcap")


def test_named_topics(mcap_of):
    path = mcap_of(bags.drive(2))
    with pytest.raises(UserError, match="no points topic /point; did you mean /points"):
        open_recording(path, points_topic="/point")
    with pytest.raises(UserError, match="no pose topic /odometry; did you mean /odom"):
        open_recording(path, pose_topic="/odometry")
    with pytest.raises(UserError, match=r"/odom .* not a point cloud; choose /points"):
        open_recording(path, points_topic="/odom")
    with pytest.raises(UserError, match=r"/points .* holds no poses; choose /odom"):
        open_recording(path, pose_topic="/points")


def test_only_suitable_topics_are_suggested(mcap_of):
    path = mcap_of([*bags.drive(2), bags.text(0.5)])
    with pytest.raises(UserError, match=r"no points topic /lidar; choose /points\.$"):
        inspect(path, points_topic="/lidar")
    with pytest.raises(UserError, match=r"no pose topic /xyz; choose /odom\.$"):
        inspect(path, pose_topic="/xyz")
    with pytest.raises(UserError, match=r"/note .* not a point cloud; choose /points"):
        inspect(path, points_topic="/note")
    bare = mcap_of([bags.text(0.5)])
    with pytest.raises(UserError, match=r"no points topic /points, nor any other\.$"):
        inspect(bare, points_topic="/points")


@pytest.mark.parametrize("harm", ["cut", "flip"])
@pytest.mark.parametrize("name", ["mcap-zstd", "mcap-plain", "mcap-unchunked", "db3", "rosbag1", "rosbag1-lz4"])
def test_damaged_files_play_or_are_refused(tmp_path, name, harm):
    path = bags.FORMATS[name](tmp_path, bags.drive(4))
    whole, random = path.read_bytes(), np.random.default_rng(len(name))
    outcomes = set()
    for _ in range(40):
        raw = bytearray(whole)
        if harm == "cut":
            raw = raw[: random.integers(0, len(raw))]
        else:
            for at in random.integers(0, len(raw), random.integers(1, 6)):
                raw[at] = random.integers(0, 256)
        path.write_bytes(raw)
        try:
            with open_recording(path) as recording:
                assert np.isfinite(recording.sweep_times).all()
                for k in range(len(recording.sweep_times)):
                    assert np.isfinite(recording.sweep(k).points).all()
            outcomes.add("played")
        except UserError as error:
            assert "\n" not in str(error)
            outcomes.add("refused")
    # A small compressed bag is a single chunk, of which damage may destroy everything.
    assert "played" in outcomes or name in ("mcap-zstd", "rosbag1-lz4")


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 17843496\n"


@pytest.mark.parametrize(
    "name", ["a.mcap", "a.bag", "a.bin", "a.pcd", "a.las", "a.txt", "a.pcap", "a.osf", "a.unknown"]
)
def test_pointers_of_git_are_named(tmp_path, name):
    for content, tool in ((POINTER, "git lfs pull"), (b"/annex/objects/SHA256E-s99--00.mcap\n", "git annex get")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=rf"{name} is not the file itself .*`{tool}`"):
            open_recording(tmp_path / name)


@pytest.mark.parametrize("suffix", ["bin", "pcd", "npy"])
def test_pointers_of_git_in_a_folder_and_of_poses_are_named(tmp_path, suffix):
    for k in range(3):
        (tmp_path / f"{k}.{suffix}").write_bytes(POINTER)
    with pytest.raises(UserError, match="git lfs pull"):
        open_recording(tmp_path)
    bags.write_mcap(tmp_path / "a.mcap", bags.drive(3))
    with pytest.raises(UserError, match="git lfs pull"):
        open_recording(tmp_path / "a.mcap", poses=tmp_path / f"0.{suffix}")
    if suffix != "bin":
        with pytest.raises(UserError, match="git lfs pull"):
            read_points(tmp_path / f"0.{suffix}")
