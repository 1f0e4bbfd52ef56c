"""A simulated Mid-360: its rays are cast into a world, and its packets go over a real socket."""

from __future__ import annotations

import contextlib
import socket

import numpy as np
import warp as wp
from numpy.typing import NDArray

from aero_planner.onboard.livox import CARTESIAN_MM, encode_packet
from aero_planner.quaternions import conjugate, quaternion_from_angles, rotate
from aero_viz.flight.vehicle import Vehicle
from aero_viz.rig.faults import Channel
from aero_viz.rig.px4_truth import PosedVehicle
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.lidar import Lidar
from aero_viz.sensors.models import LidarModel

PACKET_POINTS = 96
"""Points per packet, as in the packets of the real sensor."""

_START_STAMP = 4_321_000_000  # [ns] on the sensor's clock when the simulation starts


class SimulatedMid360:
    """A LiDAR on a simulated vehicle that sends its points over UDP.

    Args:
        world: the world that the rays are cast into.
        model: model of the sensor. A sweep must take a whole number of steps.
        address: host and UDP port of the receiver.
        period: duration of a step [s].
        seed: seed of pattern and noise.
        data_type: data type of the packets, see `aero_planner.onboard.livox`.

    Raises:
        ValueError: a step does not measure a whole number of points.

    Attributes:
        channel: the connection to the receiver.
        alive: False makes the sensor stop sending.
        sent: number of packets sent so far.
    """

    def __init__(
        self,
        world: World,
        model: LidarModel,
        address: tuple[str, int],
        *,
        period: float,
        seed: int = 0,
        data_type: int = CARTESIAN_MM,
    ) -> None:
        self._point_rate = model.points_per_sweep * model.sweep_rate  # [1/s]
        self._step_points = round(self._point_rate * period)
        self._steps_per_sweep = round(model.points_per_sweep / max(self._step_points, 1))
        if self._step_points < 1 or self._step_points * self._steps_per_sweep != model.points_per_sweep:
            raise ValueError(
                f"{model.points_per_sweep} points per sweep at {model.sweep_rate:g} Hz do not divide "
                f"into steps of {period:g} s."
            )
        self.alive = True
        self.sent = 0
        self._model, self._data_type = model, data_type
        self._lidar = Lidar(model, DeviceWorlds([world], device="cpu"), seeds=[seed])
        self._active = wp.ones(1, dtype=int, device="cpu")
        # With an identity pose as the estimated one, the LiDAR returns points in the body frame.
        identity = wp.array([(1.0, 0.0, 0.0, 0.0)], dtype=wp.vec4, device="cpu")
        self._identity_pose = wp.zeros(1, dtype=wp.vec3, device="cpu"), identity
        self._to_sensor = conjugate(quaternion_from_angles(*model.mount_angles))
        self._unsent = np.zeros((0, 3), dtype=np.float32)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = address
        self.channel = Channel(self._deliver, seed=seed)

    def step(self, tick: int, vehicle: Vehicle | PosedVehicle, now: float) -> None:
        """Measure between the poses before and after a step of the vehicle, and send all packets that are full.

        Args:
            tick: number of the step.
            vehicle: the vehicle after the step.
            now: time at the end of the step, since the start of the simulation [s].
        """
        self.channel.flush(now)
        sweep, step = divmod(tick, self._steps_per_sweep)
        first, end = step * self._step_points, (step + 1) * self._step_points
        if not self.alive:
            self._unsent = self._unsent[:0]
            return
        self._lidar.scan(
            sweep,
            first,
            end,
            poses=(vehicle.position, vehicle.quaternion),
            poses_before=(vehicle.position_before, vehicle.quaternion_before),
            active=self._active,
            estimated_poses=self._identity_pose,
            estimated_poses_before=self._identity_pose,
        )
        measured = self._to_sensor_frame(self._lidar.points.numpy()[0, first:end])  # type: ignore[index]
        points = np.concatenate([self._unsent, measured])
        number = tick * self._step_points - len(self._unsent)  # of the first point, counted from the start
        while len(points) >= PACKET_POINTS:
            data = encode_packet(
                points[:PACKET_POINTS],
                stamp_ns=_START_STAMP + round(number / self._point_rate * 1e9),
                interval=(PACKET_POINTS - 1) / self._point_rate,
                sequence=self.sent,
                data_type=self._data_type,
            )
            self.sent += 1
            self.channel.put(data, now)
            points, number = points[PACKET_POINTS:], number + PACKET_POINTS
        self._unsent = points

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _to_sensor_frame(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        if self._model.mount_angles == (0.0, 0.0, 0.0) and self._model.mount_position == (0.0, 0.0, 0.0):
            return points
        return rotate(self._to_sensor, points - np.asarray(self._model.mount_position)).astype(np.float32)

    def _deliver(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens now; a real datagram would be lost, too
            self._socket.sendto(data, self._address)
