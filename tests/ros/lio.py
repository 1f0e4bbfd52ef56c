"""A LiDAR's driver and FAST-LIO2, as their topics show them: python -m tests.ros.lio

The sensor stands 1 m above the origin and looks at a wall 5 m ahead, by a clock that began with the sensor. Ten sweeps
a second on /livox/lidar, and with each an /Odometry without a twist.
"""

from __future__ import annotations

import time

import numpy as np
from nav_msgs.msg import Odometry
from sensor_msgs.msg import PointCloud2, PointField

from aero_viz.ros.graph import Graph
from aero_viz.ros.messages import stamped

PERIOD, COUNT = 0.1, 2000
KIND = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")]
DATATYPES = {"<f4": PointField.FLOAT32, "u1": PointField.UINT8, "<f8": PointField.FLOAT64}


def main() -> None:
    rows, random = np.zeros(COUNT, KIND), np.random.default_rng(0)
    rows["x"], rows["y"], rows["z"] = 5.0, *random.uniform(-2.0, 2.0, (2, COUNT))
    fields = [
        PointField(name=name, offset=rows.dtype.fields[name][1], datatype=DATATYPES[kind], count=1)  # type: ignore[index]
        for name, kind in KIND
    ]
    with Graph("lio") as graph:
        clouds = graph.publisher("/livox/lidar", "sensor_msgs/msg/PointCloud2")
        odometry = graph.publisher("/Odometry", "nav_msgs/msg/Odometry")
        print("ready", flush=True)
        began = time.monotonic()
        while True:
            time.sleep(PERIOD)
            end = time.monotonic() - began
            start = round(1e9 * (end - PERIOD))
            rows["timestamp"] = start + np.linspace(0.0, 1e9 * PERIOD, COUNT)
            sweep = PointCloud2(height=1, width=COUNT, fields=fields, point_step=rows.itemsize)
            sweep.row_step, sweep.data = rows.nbytes, rows.tobytes()
            clouds.publish(stamped(sweep, start, "livox_frame"))
            pose = stamped(Odometry(child_frame_id="body"), round(1e9 * end), "camera_init")
            pose.pose.pose.position.z, pose.pose.pose.orientation.w = 1.0, 1.0
            pose.pose.covariance[0] = pose.pose.covariance[7] = 1e-4
            odometry.publish(pose)


if __name__ == "__main__":
    main()
