"""Decoding of depth images, sensor_msgs/Image with the intrinsics of a sensor_msgs/CameraInfo, as clouds."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aero_viz.input_limits import NAME_MAX, SWEEP_POINTS_MAX
from aero_viz.recordings.point_cloud2 import RawCloud
from aero_viz.recordings.ros_messages import DamagedMessage, decode_message

IMAGE, CAMERA_INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"

_ENCODINGS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Format of a pixel and its unit [m], by the encoding of the image."""
_ROW = np.dtype([(axis, "<f4") for axis in "xyz"])
_MOST_POINTS = 30_000
"""Number of points to which an image is reduced."""


class Intrinsics(NamedTuple):
    """Focal lengths and principal point of a camera [pixels]."""

    fx: float
    fy: float
    cx: float
    cy: float


def read_camera_info(message: bytes | memoryview, encoding: str) -> Intrinsics:
    """Return the intrinsics in a CameraInfo.

    Raises:
        DamagedMessage: the message is damaged, or the camera is not calibrated.
    """
    info: Any = decode_message(message, CAMERA_INFO, encoding)
    matrix = [float(value) for value in (info.k if hasattr(info, "k") else info.K)]
    intrinsics = Intrinsics(matrix[0], matrix[4], matrix[2], matrix[5])
    if not all(map(math.isfinite, intrinsics)) or min(intrinsics.fx, intrinsics.fy) <= 0.0:
        raise DamagedMessage("it has no focal length: the camera is not calibrated")
    return intrinsics


def read_depth_image(message: bytes | memoryview, encoding: str, camera: Intrinsics | None = None) -> RawCloud:
    """Return the points of a depth image, in the optical frame of its camera: x right, y down, z forward.

    A large image is reduced to the nearest pixels of square blocks. Without intrinsics, the rows only have the right
    number.

    Raises:
        DamagedMessage: the message is damaged, or its pixels are not depths.
    """
    image: Any = decode_message(message, IMAGE, encoding)
    if image.encoding not in _ENCODINGS:
        raise DamagedMessage(f"its encoding is {image.encoding[:NAME_MAX]!r}, not one of {', '.join(_ENCODINGS)}")
    code, unit = _ENCODINGS[image.encoding]
    dtype = np.dtype((">" if image.is_bigendian else "<") + code)
    height, width = int(image.height), int(image.width)
    row = width * dtype.itemsize
    if height * width > SWEEP_POINTS_MAX:
        raise DamagedMessage(f"it has {height * width} pixels, more than {SWEEP_POINTS_MAX}")
    if image.step < row or (height and (height - 1) * image.step + row > len(image.data)):
        raise DamagedMessage(f"{height} x {width} pixels do not fit into {len(image.data)} bytes")
    if len(image.header.frame_id) > NAME_MAX or not image.header.frame_id.isprintable():
        raise DamagedMessage("a name in it is damaged")
    block = max(math.ceil(math.sqrt(height * width / _MOST_POINTS)), 1)
    rows = np.broadcast_to(np.zeros((1, 1), _ROW), (height // block, width // block))
    if camera is not None:
        pixels = np.ndarray((height, width), dtype, image.data, 0, (image.step, dtype.itemsize))
        rows = depth_points(pixels * np.float32(unit), camera, block=block).view(_ROW)[..., 0]
    stamp = image.header.stamp.sec * 10**9 + image.header.stamp.nanosec
    return RawCloud(stamp, image.header.frame_id.lstrip("/"), rows)


def depth_points(depth: NDArray[Any], camera: Intrinsics, *, block: int = 1) -> NDArray[np.float32]:
    """Return the points of a depth image [height, width] along the optical axis [m], NaN where it has no depth.

    Args:
        depth: depths; 0 and what is not finite is none.
        camera: intrinsics for the pixels of `depth`.
        block: edge of the square blocks of which only the nearest pixel counts; pixels beyond the last whole block are
            left out.

    Returns:
        Points [m], float32 [height / block, width / block, 3], x right, y down, z forward.
    """
    rows, columns = depth.shape[0] // block, depth.shape[1] // block
    with np.errstate(invalid="ignore"):
        z = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.inf)[: rows * block, : columns * block]
    blocks = z.reshape(rows, block, columns, block).swapaxes(1, 2).reshape(rows, columns, block * block)
    nearest = blocks.argmin(axis=2)
    z = np.take_along_axis(blocks, nearest[..., None], axis=2)[..., 0].astype(np.float64)
    v = block * np.arange(rows)[:, None] + nearest // block
    u = block * np.arange(columns) + nearest % block
    z[np.isinf(z)] = np.nan
    points = (z * (u - camera.cx) / camera.fx, z * (v - camera.cy) / camera.fy, z)
    return np.ascontiguousarray(np.stack(points, axis=-1), np.float32)
