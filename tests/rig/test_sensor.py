"""The simulated Mid-360: its packets on a real socket contain points of the world."""

import socket
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner.onboard.livox import CARTESIAN_CM, CARTESIAN_MM, decode_points, parse_packet
from aero_planner.quaternions import quaternion_from_angles, rotate
from aero_viz.flight.vehicle import Vehicle
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.autopilot import PERIOD
from aero_viz.rig.sensor import PACKET_POINTS, SimulatedMid360
from aero_viz.scenes import World
from aero_viz.sensors.models import LidarModel

START = np.array([1.0, 2.0, 3.0])


@pytest.fixture
def world():
    posts = [[6.0 * np.cos(a), 6.0 * np.sin(a), 0, 0, 0, 1, 0.5, 10] for a in np.linspace(0, 6, 9)]
    ground = [0.0, 0.0, -0.5, 100.0, 100.0, 1.0, 0.0]
    return World("posts", START, np.array([20.0, 0, 3]), cylinders=np.array(posts), boxes=np.array([ground]))


@pytest.fixture
def host():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host:
        host.bind(("127.0.0.1", 0))
        host.setblocking(False)
        yield host


def received(host) -> list[Any]:
    data = []
    while True:
        try:
            data.append(host.recv(2048))
        except BlockingIOError:
            return [parse_packet(datagram) for datagram in data]


def run(world, host, *, steps=50, data_type=CARTESIAN_MM, command=(9.81, 0.0, 0.0, 0.0), **changes):
    """Fly for some steps; return the packets and the poses after each step, the start included."""
    model = LidarModel("mid360", range_noise=0.0, dropout=0.0, **changes)
    vehicle = Vehicle(VehicleModel(step=PERIOD), START[None], [0.4], period=PERIOD, device="cpu")
    sensor = SimulatedMid360(world, model, host.getsockname(), period=PERIOD, data_type=data_type)
    packets, poses = [], [(vehicle.position.numpy()[0].copy(), vehicle.quaternion.numpy()[0].copy())]
    for tick in range(steps):
        vehicle.fly(wp.array([[command]], dtype=wp.vec4), active=wp.ones(1, dtype=int), tick=tick)
        sensor.step(tick, vehicle, PERIOD * (tick + 1))
        packets += received(host)
        poses.append((vehicle.position.numpy()[0].copy(), vehicle.quaternion.numpy()[0].copy()))
    sensor.close()
    return packets, poses


def test_packets_are_like_those_of_a_real_sensor(world, host):
    packets, _ = run(world, host)
    # 0.2 s at 200 000 points per second, in packets of 96.
    assert len(packets) == 40_000 // PACKET_POINTS
    assert {packet.count for packet in packets} == {PACKET_POINTS}
    assert [packet.sequence for packet in packets] == list(range(len(packets)))
    assert set(np.diff([packet.stamp_ns for packet in packets])) == {480_000}
    assert packets[0].interval == pytest.approx(95 * 5e-6)


@pytest.mark.parametrize(("data_type", "tolerance"), [(CARTESIAN_MM, 2e-3), (CARTESIAN_CM, 0.02)])
def test_points_lie_on_surfaces_from_a_moving_drone(world, host, data_type, tolerance):
    packets, poses = run(world, host, data_type=data_type, command=(12.0, 1.0, -0.5, 1.5))
    begin = packets[0].stamp_ns
    for packet in packets[::7]:
        points, _ = decode_points(data_type, packet.payload)
        times = 1e-9 * (packet.stamp_ns - begin) + np.arange(packet.count) * 5e-6
        for point, time in zip(points[::5], times[::5], strict=True):
            if not point.any():
                continue
            k, share = int((time + 2.5e-6) / PERIOD), (time + 2.5e-6) / PERIOD % 1.0
            (p0, q0), (p1, q1) = poses[k], poses[k + 1]
            q = (1.0 - share) * q0 + share * q1
            position = (1.0 - share) * p0 + share * p1 + rotate(q / np.linalg.norm(q), point)
            assert abs(world.distance(position[None])[0]) < tolerance


def test_rays_without_a_return_are_zeros(world, host):
    packets, _ = run(world, host, steps=10)
    points = np.concatenate([decode_points(CARTESIAN_MM, packet.payload)[0] for packet in packets])
    silent = ~points.any(axis=1)
    assert 0.1 < silent.mean() < 0.9
    assert np.linalg.norm(points[~silent], axis=1).min() > 0.1


def test_a_mounted_sensor_sends_points_in_its_own_frame(world, host):
    angles, place = (180.0, 10.0, 30.0), (0.1, 0.0, -0.2)
    packets, poses = run(world, host, steps=10, mount_angles=angles, mount_position=place)
    points = np.concatenate([decode_points(CARTESIAN_MM, packet.payload)[0] for packet in packets])
    points = points[points.any(axis=1)][::20]
    in_body = rotate(quaternion_from_angles(*angles), points) + place
    positions = poses[0][0] + rotate(poses[0][1], in_body)
    assert np.abs(world.distance(positions)).max() < 2e-3
    # Its own field of view, -7 to 52 degrees.
    elevation = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    assert -7.1 < elevation.min() < elevation.max() < 52.1


def test_a_dead_sensor_sends_nothing(world, host):
    vehicle = Vehicle(VehicleModel(), START[None], [0.0], period=PERIOD, device="cpu")
    sensor = SimulatedMid360(world, LidarModel("mid360"), host.getsockname(), period=PERIOD)
    sensor.step(0, vehicle, 0.0)
    assert received(host)
    sensor.alive = False
    sensor.step(1, vehicle, 0.0)
    assert received(host) == []
    sensor.alive = True
    sensor.step(2, vehicle, 0.0)
    packets = received(host)
    sensor.close()
    # The clock has continued during the pause, which does not look like a loss of packets.
    assert packets[0].stamp_ns == 4_321_000_000 + 8_000_000
    assert packets[0].sequence == 8


def test_a_step_must_measure_a_whole_number_of_points(world):
    with pytest.raises(ValueError, match="do not divide"):
        SimulatedMid360(world, LidarModel("odd", points_per_sweep=333), ("127.0.0.1", 9), period=PERIOD)
