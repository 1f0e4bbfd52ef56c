"""The types of messages that hold point clouds, behind one function."""

from __future__ import annotations

from aero_viz.recordings.depth_image import IMAGE, Intrinsics, read_depth_image
from aero_viz.recordings.foxglove_cloud import FOXGLOVE_CLOUD, FOXGLOVE_ROS_CLOUD, read_foxglove
from aero_viz.recordings.livox import read_livox
from aero_viz.recordings.other_clouds import LASER_SCAN, read_laser_scan, read_point_cloud
from aero_viz.recordings.point_cloud2 import POINT_CLOUD2, RawCloud, read_point_cloud2
from aero_viz.recordings.velodyne_scan import VELODYNE_SCAN, read_velodyne_scan

_READERS = {
    POINT_CLOUD2: read_point_cloud2,
    "livox_ros_driver/msg/CustomMsg": read_livox,
    "livox_ros_driver2/msg/CustomMsg": read_livox,
    "livox_interfaces/msg/CustomMsg": read_livox,
    "sensor_msgs/msg/PointCloud": read_point_cloud,
    FOXGLOVE_CLOUD: read_foxglove,
    FOXGLOVE_ROS_CLOUD: read_foxglove,
    LASER_SCAN: read_laser_scan,
    VELODYNE_SCAN: read_velodyne_scan,
    IMAGE: read_depth_image,
}

CLOUD_TYPES = tuple(_READERS)
"""The preferred type first."""


def read_cloud(
    message: bytes | memoryview, type_name: str, encoding: str, camera: Intrinsics | None = None
) -> RawCloud:
    """Return the cloud in a message of one of `CLOUD_TYPES`. That in a depth image needs the intrinsics of its camera.

    Raises:
        DamagedMessage: the message is damaged or its points have no x, y and z.
    """
    if camera is not None:
        return read_depth_image(message, encoding, camera)
    return _READERS[type_name](message, encoding)
