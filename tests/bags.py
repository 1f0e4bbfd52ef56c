"""Small bags of every format, written by the writers of rosbags, mcap and mcap-ros2-support."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as McapRos2Writer
from numpy.typing import ArrayLike
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

START = 1_700_000_000_000_000_000
"""Time of the first message of every bag [ns]."""

_CODES = {"f4": 7, "f8": 8, "i4": 5, "u4": 6, "u2": 4, "u1": 2, "i8": 9, "u8": 10}
_LIVOX = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
livox_ros_driver2/CustomPoint[] points
================================================================================
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_FOXGLOVE = """builtin_interfaces/Time timestamp
string frame_id
geometry_msgs/Pose pose
uint32 point_stride
foxglove_msgs/PackedElementField[] fields
uint8[] data
================================================================================
MSG: foxglove_msgs/PackedElementField
uint8 FLOAT32=7
string name
uint32 offset
uint8 type
"""


_VELODYNE = """std_msgs/Header header
velodyne_msgs/VelodynePacket[] packets
================================================================================
MSG: velodyne_msgs/VelodynePacket
builtin_interfaces/Time stamp
uint8[1206] data
"""


def _store(ros1: bool):
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces"):
        store.register(get_types_from_msg(_LIVOX.replace("livox_ros_driver2", name), f"{name}/msg/CustomMsg"))
    store.register(get_types_from_msg(_FOXGLOVE, "foxglove_msgs/msg/PointCloud"))
    velodyne = _VELODYNE.replace("builtin_interfaces/Time", "time") if ros1 else _VELODYNE
    store.register(get_types_from_msg(velodyne, "velodyne_msgs/msg/VelodyneScan"))
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    return store


STORES = {True: _store(True), False: _store(False)}


@dataclass
class Item:
    """A message to write."""

    topic: str
    type_name: str
    time: int
    """Time of recording [ns]."""
    build: Callable[[Typestore, bool], Any]
    """Returns the message. The second argument is True for ROS 1."""


def make(store: Typestore, type_name: str, **fields):
    """Return a message of a type."""
    return store.types[type_name](**fields)


def header(store, ros1: bool, stamp: int, frame: str):
    time = make(store, "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    extra = {"seq": 0} if ros1 else {}
    return make(store, "std_msgs/msg/Header", stamp=time, frame_id=frame, **extra)


def vector(store, values, type_name="geometry_msgs/msg/Vector3"):
    return make(store, type_name, **dict(zip("xyz", map(float, values), strict=True)))


def quaternion(store, wxyz):
    return make(store, "geometry_msgs/msg/Quaternion", **dict(zip("wxyz", map(float, wxyz), strict=True)))


def cloud(seconds: float, columns: dict[str, np.ndarray], *, topic="/points", frame="lidar", big_endian=False,
          point_step: int | None = None, height=1, row_padding=0, late=0.0, stamped=True) -> Item:  # fmt: skip
    """Return a PointCloud2.

    Args:
        seconds: stamp after `START` [s].
        columns: fields of the points, in their order and of their types.
        topic: its topic.
        frame: frame in its header.
        big_endian: byte order of the points.
        point_step: bytes from one point to the next; None packs them.
        height: number of rows.
        row_padding: bytes between rows.
        late: time of recording after the stamp [s].
        stamped: False leaves the stamp unset.
    """
    order = ">" if big_endian else "<"
    dtypes = [(name, order + values.dtype.str[1:]) for name, values in columns.items()]
    packed = np.dtype(dtypes)
    step = point_step or packed.itemsize
    offsets = [packed.fields[name][1] for name in columns]  # type: ignore[index]
    rows = np.zeros(
        len(next(iter(columns.values()))),
        np.dtype({"names": list(columns), "formats": [d for _, d in dtypes], "offsets": offsets, "itemsize": step}),
    )
    for name, values in columns.items():
        rows[name] = values
    width = len(rows) // height
    raw = np.frombuffer(rows.tobytes(), np.uint8).reshape(height, width * step)
    raw = np.pad(raw, ((0, 0), (0, row_padding)), constant_values=255)
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        point_fields = [
            make(store, "sensor_msgs/msg/PointField", name=name, offset=offset, datatype=_CODES[code[1:]], count=1)
            for (name, code), offset in zip(dtypes, offsets, strict=True)
        ]
        return make(store, "sensor_msgs/msg/PointCloud2", header=header(store, ros1, stamp if stamped else 0, frame),
                    height=height, width=width, fields=point_fields, is_bigendian=big_endian, point_step=step,
                    row_step=width * step + row_padding, data=raw.reshape(-1), is_dense=True)  # fmt: skip

    return Item(topic, "sensor_msgs/msg/PointCloud2", stamp + round(late * 1e9), build)


def point_cloud(seconds: float, points: np.ndarray, *, frame="lidar") -> Item:
    """Return a sensor_msgs/PointCloud, as old drivers write it."""
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        rows = [vector(store, point, "geometry_msgs/msg/Point32") for point in points]
        channel = make(store, "sensor_msgs/msg/ChannelFloat32", name="i", values=np.ones(len(rows), np.float32))
        kind = "sensor_msgs/msg/PointCloud"
        return make(store, kind, header=header(store, ros1, stamp, frame), points=rows, channels=[channel])

    return Item("/old", "sensor_msgs/msg/PointCloud", stamp, build)


def foxglove_ros(seconds: float, points: np.ndarray, offsets: np.ndarray, position=(0, 0, 0)) -> Item:
    """Return a foxglove_msgs/PointCloud of points [n, 3] at `offsets` [n] [ns], which its pose moves to `position`."""
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        rows = np.empty(len(points), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
        rows["x"], rows["y"], rows["z"] = (np.asarray(points) - position).T
        rows["t"] = offsets
        fields = [
            make(store, "foxglove_msgs/msg/PackedElementField", name=name, offset=4 * i, type=5 if name == "t" else 7)
            for i, name in enumerate("xyzt")
        ]
        pose = make(store, "geometry_msgs/msg/Pose", position=vector(store, position, "geometry_msgs/msg/Point"),
                    orientation=quaternion(store, (1, 0, 0, 0)))  # fmt: skip
        time = make(store, "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return make(store, "foxglove_msgs/msg/PointCloud", timestamp=time, frame_id="lidar", pose=pose,
                    point_stride=16, fields=fields, data=np.frombuffer(rows.tobytes(), np.uint8))  # fmt: skip

    return Item("/foxglove", "foxglove_msgs/msg/PointCloud", stamp, build)


def livox(
    seconds: float, points: np.ndarray, offsets: np.ndarray, package="livox_ros_driver2", *, lidar: int = 0
) -> Item:
    """Return a CustomMsg of points [n, 3] measured `offsets` [n] [ns] after its stamp."""
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        rows = [
            make(store, f"{package}/msg/CustomPoint", offset_time=int(t), x=float(p[0]), y=float(p[1]),
                 z=float(p[2]), reflectivity=1, tag=0, line=0)
            for p, t in zip(points, offsets, strict=True)
        ]  # fmt: skip
        return make(store, f"{package}/msg/CustomMsg", header=header(store, ros1, stamp, "lidar"),
                    timebase=stamp, point_num=len(rows), lidar_id=lidar, rsvd=np.zeros(3, np.uint8),
                    points=rows)  # fmt: skip

    return Item("/livox/lidar", f"{package}/msg/CustomMsg", stamp, build)


def velodyne_scan(seconds: float, packets: list[tuple[float, bytes]], frame="velodyne") -> Item:
    """Return a VelodyneScan of packets at times after `seconds` [s], whose header has the time of the last one."""
    first = START + round(seconds * 1e9)
    stamps = [first + round(1e9 * offset) for offset, _ in packets]

    def build(store, ros1):
        rows = []
        for stamp, (_, data) in zip(stamps, packets, strict=True):
            time = make(store, "builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
            rows.append(make(store, "velodyne_msgs/msg/VelodynePacket", stamp=time, data=np.frombuffer(data, np.uint8)))
        head = header(store, ros1, stamps[-1], frame)
        return make(store, "velodyne_msgs/msg/VelodyneScan", header=head, packets=rows)

    return Item("/velodyne_packets", "velodyne_msgs/msg/VelodyneScan", stamps[-1], build)


def odometry(seconds: float, position, wxyz=(1, 0, 0, 0), twist=(0, 0, 0), *, topic="/odom", child="lidar",
             late=0.0, parent="odom") -> Item:  # fmt: skip
    """Return an Odometry message with the linear velocity `twist` in the child frame."""
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        pose = make(store, "geometry_msgs/msg/Pose", position=vector(store, position, "geometry_msgs/msg/Point"),
                    orientation=quaternion(store, wxyz))  # fmt: skip
        twists = make(store, "geometry_msgs/msg/Twist", linear=vector(store, twist), angular=vector(store, (0, 0, 0)))
        return make(
            store, "nav_msgs/msg/Odometry", header=header(store, ros1, stamp, parent), child_frame_id=child,
            pose=make(store, "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
            twist=make(store, "geometry_msgs/msg/TwistWithCovariance", twist=twists, covariance=np.zeros(36)),
        )  # fmt: skip

    return Item(topic, "nav_msgs/msg/Odometry", stamp + round(late * 1e9), build)


def pose_stamped(seconds: float, position, wxyz=(1, 0, 0, 0), *, topic="/pose") -> Item:
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        pose = make(store, "geometry_msgs/msg/Pose", position=vector(store, position, "geometry_msgs/msg/Point"),
                    orientation=quaternion(store, wxyz))  # fmt: skip
        return make(store, "geometry_msgs/msg/PoseStamped", header=header(store, ros1, stamp, "map"), pose=pose)

    return Item(topic, "geometry_msgs/msg/PoseStamped", stamp, build)


def transform(seconds: float, parent: str, child: str, position, wxyz=(1, 0, 0, 0), *, topic="/tf") -> Item:
    stamp = START + round(seconds * 1e9)

    def build(store, ros1):
        moved = make(store, "geometry_msgs/msg/Transform", translation=vector(store, position),
                     rotation=quaternion(store, wxyz))  # fmt: skip
        stamped = make(store, "geometry_msgs/msg/TransformStamped", header=header(store, ros1, stamp, parent),
                       child_frame_id=child, transform=moved)  # fmt: skip
        return make(store, "tf2_msgs/msg/TFMessage", transforms=[stamped])

    return Item(topic, "tf2_msgs/msg/TFMessage", stamp, build)


def text(seconds: float, topic="/note") -> Item:
    """Return a message that no reader needs."""
    return Item(topic, "std_msgs/msg/String", START + round(seconds * 1e9),
                lambda store, ros1: make(store, "std_msgs/msg/String", data="hello"))  # fmt: skip


def xyz(points: ArrayLike, code: str = "f4") -> dict[str, np.ndarray]:
    return {axis: np.asarray(points)[:, i].astype(code) for i, axis in enumerate("xyz")}


def wall(count: int = 200, seed: int = 0) -> np.ndarray:
    """Return points on a wall at x = 5 m."""
    random = np.random.default_rng(seed)
    return np.column_stack([np.full(count, 5.0), random.uniform(-3, 3, count), random.uniform(-1, 2, count)])


def drive(sweeps: int = 10, speed: float = 2.0, poses_per_sweep: int = 4, **options) -> list[Item]:
    """Return the messages of a straight flight along x, with 10 sweeps per second of a wall at x = 5 m."""
    start = np.array([100.0, 50.0, 2.0])
    items: list[Item] = []
    for k in range((sweeps - 1) * poses_per_sweep + 1):
        t = 0.1 * k / poses_per_sweep
        items.append(odometry(t, np.add(start, [speed * t, 0, 0]), twist=(speed, 0, 0), **options))
    for k in range(sweeps):
        items.append(cloud(0.1 * k, xyz(wall(seed=k) - [speed * 0.1 * k, 0, 0])))
    return sorted(items, key=lambda item: item.time)


def _write_ros(writer, ros1: bool, items: Iterable[Item]) -> None:
    store, connections = STORES[ros1], {}
    for item in items:
        key = (item.topic, item.type_name)
        if key not in connections:
            connections[key] = writer.add_connection(item.topic, item.type_name, typestore=store)
        message = item.build(store, ros1)
        raw = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, item.type_name)
        writer.write(connections[key], item.time, raw)


def write_ros1(path: Path, items: Iterable[Item], compression: str | None = None) -> Path:
    writer = Writer1(path)
    if compression:
        writer.set_compression(getattr(Writer1.CompressionFormat, compression.upper()))
    with writer:
        _write_ros(writer, True, items)
    return path


def write_ros2(path: Path, items: Iterable[Item], plugin: str, compression: str | None = None) -> Path:
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin[plugin.upper()])
    if compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        _write_ros(writer, False, items)
    return path


def write_mcap(path: Path, items: Iterable[Item], *, compression=CompressionType.ZSTD, chunk_size=20_000,
               ros1=False, chunked=True) -> Path:  # fmt: skip
    store, channels = STORES[ros1], {}
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_size, compression=compression, use_chunking=chunked)
        writer.start(profile="ros1" if ros1 else "ros2")
        for item in items:
            if item.topic not in channels:
                name = item.type_name.replace("/msg/", "/") if ros1 else item.type_name
                definition = store.generate_msgdef(item.type_name, ros_version=1 if ros1 else 2)[0].encode()
                schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", definition)
                channels[item.topic] = writer.register_channel(item.topic, "ros1" if ros1 else "cdr", schema)
            message = item.build(store, ros1)
            raw = (store.serialize_ros1 if ros1 else store.serialize_cdr)(message, item.type_name)
            writer.add_message(channels[item.topic], item.time, bytes(raw), item.time)
        writer.finish()
    return path


def _as_dict(value: Any) -> Any:
    """Return a message of rosbags as dicts and lists."""
    if is_dataclass(value):
        return {field.name: _as_dict(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, list):
        return [_as_dict(item) for item in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def write_mcap_ros2(path: Path, items: Iterable[Item]) -> Path:
    """Write an MCAP file whose messages are encoded by mcap-ros2-support instead of rosbags."""
    store, schemas = STORES[False], {}
    writer = McapRos2Writer(str(path), chunk_size=20_000)
    for item in items:
        if item.type_name not in schemas:
            definition = store.generate_msgdef(item.type_name, ros_version=2)[0]
            schemas[item.type_name] = writer.register_msgdef(item.type_name, definition)
        message = _as_dict(item.build(store, False))
        writer.write_message(item.topic, schemas[item.type_name], message, item.time, item.time)
    writer.finish()
    return path


FORMATS: dict[str, Callable[[Path, list[Item]], Path]] = {
    "mcap-zstd": lambda folder, items: write_mcap(folder / "a.mcap", items),
    "mcap-lz4": lambda folder, items: write_mcap(folder / "a.mcap", items, compression=CompressionType.LZ4),
    "mcap-plain": lambda folder, items: write_mcap(folder / "a.mcap", items, compression=CompressionType.NONE),
    "mcap-unchunked": lambda folder, items: write_mcap(folder / "a.mcap", items, chunked=False),
    "mcap-ros2-support": lambda folder, items: write_mcap_ros2(folder / "a.mcap", items),
    "mcap-ros1": lambda folder, items: write_mcap(folder / "a.mcap", items, ros1=True),
    "rosbag2-mcap": lambda folder, items: write_ros2(folder / "bag", items, "mcap"),
    "rosbag2-sqlite3": lambda folder, items: write_ros2(folder / "bag", items, "sqlite3"),
    "rosbag2-message": lambda folder, items: write_ros2(folder / "bag", items, "sqlite3", "message"),
    "rosbag2-file": lambda folder, items: write_ros2(folder / "bag", items, "sqlite3", "file"),
    "rosbag2-storage": lambda folder, items: write_ros2(folder / "bag", items, "mcap", "storage"),
    "db3": lambda folder, items: next(write_ros2(folder / "bag", items, "sqlite3").glob("*.db3")),
    "rosbag1": lambda folder, items: write_ros1(folder / "a.bag", items),
    "rosbag1-lz4": lambda folder, items: write_ros1(folder / "a.bag", items, "lz4"),
    "rosbag1-bz2": lambda folder, items: write_ros1(folder / "a.bag", items, "bz2"),
}


def depth_image(
    seconds: float, depth: np.ndarray, *, topic="/camera/depth/image_raw", encoding="16UC1", padding=0
) -> Item:
    """Return a sensor_msgs/Image of depths [height, width] [m], with some bytes between its rows."""
    stamp = START + round(seconds * 1e9)
    pixels = np.round(depth * 1e3).astype("<u2") if encoding == "16UC1" else depth.astype("<f4")
    height, width = depth.shape
    raw = np.pad(np.frombuffer(pixels.tobytes(), np.uint8).reshape(height, -1), ((0, 0), (0, padding)))

    def build(store, ros1):
        return make(store, "sensor_msgs/msg/Image", header=header(store, ros1, stamp, "camera_optical_frame"),
                    height=height, width=width, encoding=encoding, is_bigendian=0, step=raw.shape[1],
                    data=raw.reshape(-1))  # fmt: skip

    return Item(topic, "sensor_msgs/msg/Image", stamp, build)


def camera_info(seconds: float, intrinsics, shape, *, topic="/camera/depth/camera_info") -> Item:
    """Return a sensor_msgs/CameraInfo with fx, fy, cx, cy for an image of a shape (height, width)."""
    stamp = START + round(seconds * 1e9)
    fx, fy, cx, cy = intrinsics

    def build(store, ros1):
        region = make(store, "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0,
                      do_rectify=False)  # fmt: skip
        matrices = {
            "d": np.zeros(5), "k": np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1.0]), "r": np.eye(3).ravel(),
            "p": np.array([fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1.0, 0]),
        }  # fmt: skip
        named = {(name.upper() if ros1 else name): values for name, values in matrices.items()}
        return make(store, "sensor_msgs/msg/CameraInfo", header=header(store, ros1, stamp, "camera_optical_frame"),
                    height=shape[0], width=shape[1], distortion_model="plumb_bob", binning_x=0, binning_y=0,
                    roi=region, **named)  # fmt: skip

    return Item(topic, "sensor_msgs/msg/CameraInfo", stamp, build)
