"""Whole files of every format, written by the libraries that others write them with."""

import importlib.util
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bags
import captures
import laspy
import numpy as np
import trimesh
from PIL import Image

from aero_planner.onboard.flight_config import format_onboard
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.reader_process import ReaderProcess

_POINTS = np.random.default_rng(0).uniform(-9.0, 9.0, (300, 3))
_BOX = trimesh.creation.box((6.0, 6.0, 6.0)).subdivide()
_WORLD = {
    "name": "w", "start": [0, 0, 2], "goal": [9, 0, 2], "cylinders": [[4, 3, 0, 0, 0, 1, 0.3, 4]],
    "boxes": [[5, 0, -0.5, 60, 60, 1, 0]], "spheres": [[3, 3, 3, 0.5]], "bounds": [[-20, -20, -2], [30, 20, 20]],
}  # fmt: skip
_MAP = "image: maze.pgm\nresolution: 0.2\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\noccupied_thresh: 0.65\n"
_SHAPE = "<geometry><cylinder><radius>0.3</radius><length>4</length></cylinder></geometry>"
_SDF = f"""<?xml version='1.0'?><sdf version='1.6'><world name='default'><model name='tree'><pose>1 2 2 0 0 0</pose>
<link name='link'><collision name='c'>{_SHAPE}</collision></link></model></world></sdf>"""
_CONFIG = "preset: paper\ncosts:\n  q_track: 5.0  # comment\nonboard:\n  limits:\n    plan_age: 0.2\n"


def _las(version: str) -> Callable[[Path], Any]:
    def write(path: Path) -> None:
        content = laspy.LasData(laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version))
        content.header.scales = np.full(3, 0.001)
        content.x, content.y, content.z = _POINTS.T
        content.write(str(path))

    return write


def _open3d(**options: Any) -> Callable[[Path], Any]:
    def write(path: Path) -> None:
        import open3d

        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_POINTS))
        assert open3d.io.write_point_cloud(path, cloud, **options)

    return write


def _mesh(**options: str) -> Callable[[Path], Any]:
    return lambda path: _BOX.export(path, **options)


def _bag(name: str) -> Callable[[Path], Any]:
    def write(path: Path) -> None:
        items = [*bags.drive(4), bags.transform(0, "base", "lidar", [0, 0, 1], topic="/tf_static")]
        items.append(bags.livox(0.15, bags.wall(30), np.arange(30) * 1000))
        path.mkdir()
        bags.FORMATS[name](path, sorted(items, key=lambda item: item.time))

    return write


def _clouds(path: Path) -> None:
    """Write a folder of clouds with times and poses."""
    path.mkdir()
    for k in range(4):
        np.column_stack([_POINTS, np.ones(len(_POINTS))]).astype("<f4").tofile(path / f"{k}.bin")
    np.savetxt(path / "times.txt", 0.1 * np.arange(4))
    np.savetxt(path / "poses.txt", [[0.1 * k, k, 0, 1, 0, 0, 0, 1] for k in range(4)], fmt="%.3f")


def _tum(path: Path) -> None:
    np.savetxt(path, [[0.1 * k, k, 0, 1, 0, 0, 0, 1] for k in range(20)], fmt="%.4f", header="time x y z")


def _kitti(path: Path) -> None:
    np.savetxt(path, [np.hstack([np.eye(3), [[0.1 * k], [0], [1]]]).reshape(-1) for k in range(20)])


def _foxglove(path: Path) -> None:
    from foxglove import open_mcap
    from foxglove.channels import PointCloudChannel
    from foxglove.mcap import MCAPWriteOptions
    from foxglove.messages import PackedElementField, PackedElementFieldNumericType, PointCloud, Timestamp

    kind, data = PackedElementFieldNumericType.Float32, _POINTS.astype("<f4").tobytes()
    fields = [PackedElementField(name=axis, offset=4 * i, type=kind) for i, axis in enumerate("xyz")]
    with open_mcap(str(path), writer_options=MCAPWriteOptions(use_chunks=False, calculate_data_section_crc=False)):
        channel = PointCloudChannel(f"/{path.stem}")
        for k in range(3):
            stamp = Timestamp(sec=1_700_000_000, nsec=100_000_000 * k)
            cloud = PointCloud(timestamp=stamp, frame_id="lidar", point_stride=12, fields=fields, data=data)
            channel.log(cloud, log_time=1_700_000_000_000_000_000 + 100_000_000 * k)
        channel.close()


def _scans(path: Path) -> None:
    bags.write_mcap(path, [captures.laser_scan(0.1 * k) for k in range(4)], chunked=False)


def _ouster(path: Path) -> None:
    """Write an OSF file, or a folder with a capture and its metadata."""
    with tempfile.TemporaryDirectory() as folder:
        ReaderProcess()(captures.write_ouster, Path(folder) / "hall")
        if path.suffix == ".osf":
            shutil.copy(Path(folder) / "hall.osf", path)
        else:
            (Path(folder) / "hall.osf").unlink()
            shutil.copytree(folder, path)


def _flight_log(path: Path) -> None:
    """Log half a second of a flight."""
    from small_source import small_config, small_source

    from aero_viz.logs import flight_recorder
    from aero_viz.session import Session

    session = Session(small_source(), config=small_config())
    with flight_recorder(path) as log:
        for _ in range(8):
            log.write(session.tick())
    session.close()


def _image(path: Path) -> None:
    pixels = np.full((40, 60), 255, np.uint8)
    pixels[:10, 50:] = 0
    Image.fromarray(pixels).save(path)


def _map_server(path: Path) -> None:
    """Write a map of ROS's map server."""
    path.mkdir()
    _image(path / "maze.pgm")
    (path / "a.yaml").write_text(_MAP)


SEEDS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    **{f"{name}.bagfolder": ("recording", _bag(name)) for name in bags.FORMATS},
    **{f"{version}.{suffix}": ("points", _las(version)) for version in ("1.2", "1.4") for suffix in ("las", "laz")},
    "ascii.pcd": ("points", _open3d(write_ascii=True)),
    "binary.pcd": ("points", _open3d()),
    "compressed.pcd": ("points", _open3d(compressed=True)),
    "ascii.ply": ("points", _open3d(write_ascii=True)),
    "binary.ply": ("points", _open3d()),
    "mesh.ply": ("points", _mesh()),
    "mesh_ascii.ply": ("points", _mesh(encoding="ascii")),
    "a.npy": ("points", lambda path: np.save(path, _POINTS)),
    "a.xyz": ("points", lambda path: np.savetxt(path, _POINTS, fmt="%.4f")),
    "a.pts": ("points", lambda path: np.savetxt(path, _POINTS, fmt="%.4f", header="300", comments="")),
    "a.obj": ("points", _mesh()),
    "binary.stl": ("points", _mesh()),
    "ascii.stl": ("points", _mesh(file_type="stl_ascii")),
    "a.glb": ("points", _mesh()),
    "a.off": ("points", _mesh()),
    "mid360.pcap": ("recording", captures.write_mid360),
    "vlp16.pcap": ("recording", captures.write_vlp16),
    "mid360.lvx2": ("recording", lambda path: captures.write_lvx2(path, captures.livox_packets(3))),
    **{name: ("capture", _ouster) for name in ("hall.ouster", "hall.osf") if importlib.util.find_spec("ouster")},
    "foxglove.mcap": ("recording", _foxglove),
    "scans.mcap": ("recording", _scans),
    "kitti.clouds": ("recording", _clouds),
    "tum.txt": ("poses", _tum),
    "kitti.txt": ("poses", _kitti),
    "flight.ulg": ("poses", lambda path: captures.write_ulog(path, 20, utc=1.7e9)),
    "a.json": ("world", lambda path: path.write_text(json.dumps(_WORLD))),
    "a.world": ("solids", lambda path: path.write_text(_SDF)),
    "a.png": ("solids", _image),
    "server.map": ("solids", _map_server),
    "flight.mcap": ("log", _flight_log),
    "onboard.yaml": ("config", lambda path: path.write_text(format_onboard(OnboardConfig()))),
    "a.yaml": ("config", lambda path: path.write_text(_CONFIG)),
}
"""By file name: the target, and the function that writes the file."""


def mutable_files(seed: Path) -> tuple[Path, list[Path]]:
    """Return what a target opens of a seed, and the files in it."""
    if not seed.is_dir():
        return seed, [seed]
    files = sorted(file for file in seed.rglob("*") if file.is_file())
    opened = files if len(files) == 1 else list(seed.glob("*.pcap"))
    return (opened[0] if opened else files[0].parent, files)
