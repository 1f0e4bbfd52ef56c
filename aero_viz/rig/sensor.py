"""A simulated Mid-360: rays into a world, sent as the packets of a real one over a real socket."""

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
from aero_viz.scenes import World
from aero_viz.scenes.device_worlds import DeviceWorlds
from aero_viz.sensors.lidar import Lidar, LidarModel

__all__ = ["PACKET_POINTS", "SimulatedMid360"]

PACKET_POINTS = 96
"""Points per packet, as the sensor sends them."""

_POWER_ON = 4_321_000_000  # [ns] by the sensor's clock when the simulation starts


class SimulatedMid360:
    """A LiDAR on a simulated vehicle that sends what it sees.

    Args:
        world: what there is to see.
        model: of the sensor; a sweep takes a whole number of steps.
        address: host and UDP port to send to.
        period: of a step [s].
        seed: of pattern and noise.
        data_type: of the packets.

    Raises:
        ValueError: a step measures no whole number of points.

    Attributes:
        channel: the wire to the host.
        alive: False stops it.
        sent: packets so far.
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
        self._rate = model.points_per_sweep * model.sweep_rate
        self._count = round(self._rate * period)
        self._parts = round(model.points_per_sweep / max(self._count, 1))
        if self._count < 1 or self._count * self._parts != model.points_per_sweep:
            raise ValueError(
                f"{model.points_per_sweep} points per sweep at {model.sweep_rate:g} Hz do not divide "
                f"into steps of {period:g} s."
            )
        self.alive = True
        self.sent = 0
        self._model, self._data_type = model, data_type
        self._lidar = Lidar(model, DeviceWorlds([world], device="cpu"), seeds=[seed])
        self._flying = wp.zeros(1, dtype=int, device="cpu")
        # Points are believed to be where the body frame is, so that they come in the body frame.
        self._here = wp.zeros(1, dtype=wp.vec3, device="cpu"), wp.array([(1.0, 0, 0, 0)], dtype=wp.vec4, device="cpu")
        self._to_sensor = conjugate(quaternion_from_angles(*model.mount_angles))
        self._rest = np.zeros((0, 3), dtype=np.float32)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._address = address
        self.channel = Channel(self._deliver, seed=seed)

    def step(self, tick: int, vehicle: Vehicle, now: float) -> None:
        """Measure from the poses before and after the step `tick` of `vehicle`, and send what fills packets."""
        self.channel.flush(now)
        sweep, part = divmod(tick, self._parts)
        first, end = part * self._count, (part + 1) * self._count
        if not self.alive:
            self._rest = self._rest[:0]
            return
        self._lidar.scan(
            sweep,
            first,
            end,
            poses=(vehicle.position, vehicle.quaternion),
            poses_before=(vehicle.position_before, vehicle.quaternion_before),
            finished=self._flying,
            believed=self._here,
            believed_before=self._here,
        )
        measured = self._to_sensor_frame(self._lidar.points.numpy()[0, first:end])  # type: ignore[index]
        points = np.concatenate([self._rest, measured])
        number = tick * self._count - len(self._rest)  # of points[0], since the start
        while len(points) >= PACKET_POINTS:
            data = encode_packet(
                points[:PACKET_POINTS],
                stamp_ns=_POWER_ON + round(number / self._rate * 1e9),
                interval=(PACKET_POINTS - 1) / self._rate,
                sequence=self.sent,
                data_type=self._data_type,
            )
            self.sent += 1
            self.channel.put(data, now)
            points, number = points[PACKET_POINTS:], number + PACKET_POINTS
        self._rest = points

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _to_sensor_frame(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        if self._model.mount_angles == (0.0, 0.0, 0.0) and self._model.mount_position == (0.0, 0.0, 0.0):
            return points
        return rotate(self._to_sensor, points - np.asarray(self._model.mount_position)).astype(np.float32)

    def _deliver(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody listens there now, as on a wire
            self._socket.sendto(data, self._address)
