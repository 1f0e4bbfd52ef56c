"""The onboard node beside a driver and FAST-LIO2: points and state from ROS 2, all else over MAVLink."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aero_planner.config import PlannerConfig, VehicleConfig
from aero_planner.config.file import format_config
from aero_planner.onboard.connections import open_lidar, open_link, ros_inputs
from aero_planner.onboard.flight_config import format_onboard
from aero_planner.onboard.input_checks import check_inputs
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.rig.rig import free_ports
from tests.planner.onboard.mavlink_peer import Peer, landed_state, odometry
from tests.planner.onboard.simulated import SMALL
from tests.ros.conftest import Start, wait_until
from tests.ros.test_publishing import Peer as Program


class Drone:
    """The connections of a node, and a PX4 that fuses the odometry, or is `offset` metres away by its own estimate."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        (port,) = free_ports(1)
        names = {"lidar.source": "ros", "state.source": "ros", "mavlink.url": f"udpin:127.0.0.1:{port}"}
        self.config = OnboardConfig().replace({**names, "lidar.mount_pitch": 10.0, "lidar.mount_z": 0.2})
        ros = stack.enter_context(ros_inputs(self.config))
        self.link = stack.enter_context(contextlib.closing(open_link(self.config, VehicleConfig(), ros)))
        self.lidar = stack.enter_context(contextlib.closing(open_lidar(self.config, ros)))
        self._autopilot, self.offset = Peer(port), 0.0
        stack.callback(self._autopilot.socket.close)

    def step(self, *_: object) -> Any:
        """Let the autopilot send its messages, and return the sample of the link."""
        self._autopilot.heartbeat(base=1, mode=0)
        self._autopilot.send(odometry((self.offset, 0, -1), time=time.monotonic()), landed_state(1))
        self.link.poll()
        time.sleep(0.01)
        return self.link.state


@pytest.fixture
def drone(domain: int) -> Iterator[Drone]:
    with contextlib.ExitStack() as stack:
        yield Drone(stack)


def test_points_and_state_come_from_their_topics_and_fit_each_other(drone: Drone, start: Start):
    start("tests.ros.lio")
    wait_until(lambda: drone.step() and drone.lidar.poll())
    for check in (checks := check_inputs(drone.link, drone.lidar, drone.config, listen=2.0, sleep=drone.step)):
        assert check.ok or check.name in ("vehicle state", "transmitter", "GNSS fix", "goal", "velocity uncertainty",
                                          "cloud against itself", "round trip"), check  # fmt: skip
    found = {check.name: check.finding for check in checks}
    assert found["deskewing"] == "100 % of the points have a pose" and "lost 0.0 %" in found["packets"]
    assert found["position uncertainty"].startswith("0.01 m")
    sample = drone.step()
    # 1 m up by the odometry of a sensor that looks 10 degrees down: forward and up for the body.
    np.testing.assert_allclose(sample.state.position, [np.sin(np.radians(10.0)), 0.0, np.cos(np.radians(10.0))])
    np.testing.assert_allclose(sample.state.quaternion, [1.0, 0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(sample.state.velocity, 0.0, atol=1e-6)
    assert not sample.armed and sample.in_air is False


def test_without_its_topics_or_against_the_autopilot_there_is_no_new_state(drone: Drone, start: Start):
    assert drone.step() is None and drone.lidar.poll() == []
    lio = start("tests.ros.lio")
    wait_until(drone.step)
    drone.offset = 5.0
    last = drone.step().time
    wait_until(lambda: drone.step() and "/Odometry more than 2 m" in " ".join(drone.link.dropped))
    assert time.monotonic() - drone.step().time < 30.0 and drone.step().time <= last + 0.2
    drone.offset = 0.0
    wait_until(lambda: time.monotonic() - drone.step().time < 0.2)
    lio.kill()
    wait_until(lambda: time.monotonic() - drone.step().time > drone.config.limits.state_age)
    start("tests.ros.lio")  # its clock begins again
    wait_until(lambda: time.monotonic() - drone.step().time < 0.2 and drone.lidar.poll())


@pytest.fixture
def running(domain: int, tmp_path: Path) -> Iterator[None]:
    """A node that runs with inputs from ROS, and hears neither sensor nor autopilot, which may therefore be armed."""
    (port,) = free_ports(1)
    settings = {
        "lidar.source": "ros", "mavlink.url": f"udpin:127.0.0.1:{port}", "telemetry.enabled": False,
        "tuning.limits": "vehicle.speed_limit 1..6, costs.q_track 1..30, candidates.prefer_safe",
    }  # fmt: skip
    (tmp_path / "flight.yaml").write_text(format_config(SMALL) + format_onboard(OnboardConfig().replace(settings)))
    command = [sys.executable, "-m", "aero_planner", "run", "--config", str(tmp_path / "flight.yaml")]
    process = subprocess.Popen(command)
    yield
    process.terminate()
    assert process.wait(30) == 0


def test_who_sets_a_parameter_twice_changes_the_one_in_force(running: None, start: Start):
    peer = Program(start("tests.ros.peer", "/aero_planner/tuning"))
    speed, others = "vehicle.speed_limit", ["costs.q_track", "candidates.prefer_safe"]
    (described, *_) = peer.ask(describe=[speed, *others])
    assert described["floating_point_range"] == [{"from_value": 1.0, "to_value": 6.0, "step": 0.0}]
    assert PlannerConfig.find(speed).help in described["description"]
    assert peer.ask(get=[speed, *others]) == [5.0, 5.0, SMALL.candidates.prefer_safe]
    (reason,) = peer.ask(set={speed: 3})
    assert "armed" in reason and "Set the same again" in reason and peer.ask(get=[speed]) == [5.0]
    time.sleep(1.0)
    assert peer.ask(set={speed: 3}) == [""]
    wait_until(lambda: peer.ask(get=[speed]) == [3.0])
    assert "6" in peer.ask(set={speed: 6.5})[0]
    assert peer.ask(set={"vehicle.mass": 1.5})[0] and peer.ask(describe=["vehicle.mass"]) == []


def test_a_node_that_asks_for_nothing_of_ros_imports_nothing_of_it():
    code = """
import sys
from aero_planner.onboard import connections, preflight, run
from aero_planner.onboard.settings import OnboardConfig
with connections.ros_inputs(OnboardConfig()) as ros:
    assert ros is None and "rclpy" not in sys.modules
sys.modules["rclpy"] = None
try:
    with connections.ros_inputs(OnboardConfig().replace({"lidar.source": "ros"})):
        pass
except ImportError as error:
    print(error)
"""
    said = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert "lidar.source or state.source is ros" in said and "source /opt/ros" in said


def test_beside_a_sensor_that_is_read_directly_the_stamps_must_be_of_this_computer(domain: int, start: Start):
    config = OnboardConfig().replace({"state.source": "ros"})
    with ros_inputs(config) as ros:
        assert ros is not None and ros.points is None and ros.odometry is not None
        odometry = ros.odometry
        start("tests.ros.lio")  # whose clock began with the sensor

        def refused() -> str:
            odometry.place(None)
            return " ".join(odometry.dropped)

        wait_until(refused)
        assert "/Odometry with stamps of another clock than this computer's" in refused()
