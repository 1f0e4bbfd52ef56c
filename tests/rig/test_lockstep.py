"""Blind braking on the rig in simulated time: the node is killed, paused or loses its state at full speed."""

import itertools
import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.ground_tracker import GroundSource
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.flight import FlightRules
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.lockstep import LockstepRig
from aero_viz.rig.offboard import Mode
from aero_viz.rig.rig import PX4_RESPONSE
from aero_viz.scenes import World
from aero_viz.sensors import LIDARS, LidarModel

CONFIG = PlannerConfig.preset("fast-cpu").replace({"vehicle.speed_limit": 5.0})
LIMITS = OnboardConfig().limits
MID360 = LIDARS["mid360"]
QUARTER = LidarModel("quarter", pattern="livox", points_per_sweep=5000)
"""A Mid-360 of a quarter of the points: it is the points that take most of the time."""
GROUND = [15.0, 0, -0.5, 120, 80, 1, 0]


@pytest.fixture(scope="module")
def planner() -> Iterator[Planner]:
    planner = Planner(CONFIG, device="cpu", threads=1)
    yield planner
    planner.close()


def avenue(*posts: tuple[float, float]) -> World:
    """Return a world with a row of posts on both sides of the way, and more posts in between."""
    places = [(float(x), side * 3.5) for x in range(0, 40, 3) for side in (-1.0, 1.0)] + list(posts)
    cylinders = np.array([[x, y, 0, 0, 0, 1, 0.3, 8] for x, y in places])
    return World("avenue", np.array([0.0, 0, 2]), np.array([30.0, 0, 2]), cylinders, np.array([GROUND]))


def test_a_moving_pillar_hits_a_drone_that_cannot_see_it(planner):
    """The drone hovers at its goal, with its LiDAR off, and a pillar comes to it."""
    start, pillar = np.array([0.0, 0, 2]), [[16.0, 0, 0, 0, 0, 1, 0.3, 8]]
    world = World("visit", start, start, np.array(pillar), np.array([GROUND]), motion=np.array([[-1.6, 0.0, 40.0]]))
    with LockstepRig(planner, world, lidar=QUARTER) as rig:
        assert rig.take_over()
        rig.sensor.alive = False
        while not rig.collided:
            rig.run(0.02)
            assert rig.now < 12.0
        place = 16.0 - 1.6 * rig.now
        assert rig.autopilot.position[0] == pytest.approx(place - 0.3 - FlightRules().radius, abs=0.05)


def at_full_speed(rig: LockstepRig) -> None:
    assert rig.take_over()
    while rig.speed < 4.0:
        rig.run(0.02)
        assert rig.now < 20.0 and not rig.collided
    rig.run(0.4)


def run_until_handed_back(rig: LockstepRig) -> None:
    end = rig.now + 6.0
    while rig.autopilot.mode is Mode.OFFBOARD:
        rig.run(0.02)
        assert rig.now < end


def kill(rig: LockstepRig) -> None:
    rig.node_lives = False


def stop(rig: LockstepRig) -> None:
    rig.node_runs = False


def freeze(rig: LockstepRig) -> None:
    rig.autopilot.frozen = True


@pytest.mark.parametrize(
    ("fault", "lidar", "factor", "speed"),
    [(kill, QUARTER, 1.0, 0.35), (stop, QUARTER, 1.0, 0.4), (freeze, MID360, 1.0, 0.4), (kill, QUARTER, 0.7, 0.7)],
    ids=["kill", "stop", "freeze", "kill a slower drone"],
)
def test_a_blind_drone_is_handed_back_at_rest_and_level(
    planner: Planner, fault: Callable[[LockstepRig], None], lidar: LidarModel, factor: float, speed: float
):
    # The last drone responds otherwise than the node assumes.
    response = PX4_RESPONSE | {"rate_lag": 0.07 / factor, "drag": 0.3 * factor}
    vehicle = VehicleModel.from_config(CONFIG, **response)
    with LockstepRig(planner, avenue((12.0, 0.6)), vehicle=vehicle, seed=1, lidar=lidar) as rig:
        at_full_speed(rig)
        fault(rig)
        run_until_handed_back(rig)
        assert rig.speed < speed and math.degrees(rig.tilt) < 1.0 and not rig.collided
        # It is still at rest when the autopilot holds it.
        rig.run(2.0)
        assert not rig.collided


def brake_without_fix(rig: LockstepRig) -> None:
    """Take the GNSS fix away at full speed, and run until the drone brakes."""
    at_full_speed(rig)
    rig.autopilot.lose_position()
    lost = rig.now
    while rig.node.state is not State.BRAKING:
        rig.run(0.02)
        assert rig.now - lost < 1.0


def test_a_drone_that_loses_its_gnss_fix_brakes_within_a_second_and_is_handed_back(planner: Planner):
    with LockstepRig(planner, avenue((12.0, 0.6)), seed=1, lidar=MID360) as rig:
        brake_without_fix(rig)
        rig.run(2.0)
        assert rig.speed < 0.5 and not rig.collided
        rig.run(LIMITS.brake_time - 2.0 - 0.1)
        # The estimator's velocity is off by 0.39 m/s. The LiDAR tells.
        assert rig.autopilot.mode is Mode.OFFBOARD and rig.speed < 0.15
        rig.run(0.7)
        assert rig.autopilot.mode is Mode.HOLD and math.degrees(rig.tilt) < 1.0 and not rig.collided


def test_a_drone_that_has_its_gnss_fix_again_flies_on(planner: Planner):
    with LockstepRig(planner, avenue((12.0, 0.6)), seed=1, lidar=QUARTER) as rig:
        brake_without_fix(rig)
        rig.run(1.0)
        rig.autopilot.lose_position(False)
        rig.run(0.5)
        assert rig.node.state is State.FLYING and rig.autopilot.mode is Mode.OFFBOARD and not rig.collided


@pytest.mark.parametrize("error", [0.6, -1.2])
def test_a_velocity_that_begins_to_err_in_flight_brakes_within_a_second(planner: Planner, error: float):
    with LockstepRig(planner, avenue((12.0, 0.6)), seed=1, lidar=MID360) as rig:
        at_full_speed(rig)
        assert all(change.target is not State.BRAKING for change in rig.node.changes)
        rig.autopilot.velocity_error = error
        rig.run(1.0)
        assert str(rig.node.changes[-1]).startswith("FLYING -> BRAKING: the cloud does not stand still")
        # It comes to rest by the LiDAR's velocity and is handed back.
        rig.run(2.5)
        assert rig.speed < 0.35 and not rig.collided
        rig.run(3.0)
        assert rig.node.state is State.HANDED_BACK and not rig.collided


def make_late(rig: LockstepRig, delay: float) -> None:
    for channel in (rig.autopilot.to_companion, rig.autopilot.from_companion):
        channel.faults["delay"] = delay


def test_a_drone_whose_link_becomes_late_brakes_within_the_stated_time_and_is_handed_back(planner: Planner):
    with LockstepRig(planner, avenue(), seed=1, lidar=QUARTER) as rig:
        at_full_speed(rig)
        make_late(rig, 0.11)
        rig.run(LIMITS.round_trip_time + 0.1)
        assert any(change.cause is Cause.LINK_LATE for change in rig.node.changes)
        lowest = rig.autopilot.position[2]
        while rig.autopilot.mode is Mode.OFFBOARD:
            rig.run(0.02)
            lowest = min(lowest, rig.autopilot.position[2])
            assert rig.now < 40.0 and not rig.collided
        assert lowest > 2.0 - 1.2


def test_on_a_link_that_is_late_from_the_start_nothing_is_ready(planner: Planner):
    with LockstepRig(planner, avenue(), seed=1, lidar=QUARTER) as rig:
        make_late(rig, 0.11)
        assert not rig.take_over(6.0)
        assert Cause.LINK_LATE in rig.node.safety.missing()


@pytest.mark.parametrize("reserve", ["transmitter", "battery"])
def test_a_drone_without_reserves_stops_where_it_sees_and_is_handed_over_at_rest(planner: Planner, reserve: str):
    onboard = OnboardConfig().replace({"limits.hold_time": 0.5, "limits.brake_time": 2.0})
    with LockstepRig(planner, avenue((12.0, 0.6)), seed=1, lidar=QUARTER, onboard=onboard) as rig:
        at_full_speed(rig)
        if reserve == "transmitter":
            rig.autopilot.lose_transmitter()
        else:
            rig.autopilot.drain_battery()
        rig.run(1.1)
        assert rig.node.state in (State.BRAKING, State.HOLDING) and rig.autopilot.mode is Mode.OFFBOARD
        run_until_handed_back(rig)
        assert rig.speed < 0.1 and math.degrees(rig.tilt) < 1.0 and not rig.collided


def test_without_the_recommended_parameter_px4_holds_in_full_flight_when_the_transmitter_is_lost(planner: Planner):
    with LockstepRig(planner, avenue(), seed=1, lidar=QUARTER) as rig:
        rig.autopilot.parameters["COM_RCL_EXCEPT"] = 0
        at_full_speed(rig)
        rig.autopilot.lose_transmitter()
        assert rig.autopilot.mode is Mode.HOLD and rig.speed > 4.0
        rig.run(1.5)
        assert rig.node.state is State.WAITING


@pytest.mark.parametrize("read_time", [1e-6, 1e-4, 2.5e-4], ids=["at once", "in 3 ticks", "in 8 ticks"])
def test_a_paused_node_finds_a_slower_drone_and_flies_on(
    planner: Planner, monkeypatch: pytest.MonkeyPatch, read_time: float
):
    with LockstepRig(planner, avenue((12.0, 0.6)), seed=2, lidar=QUARTER) as rig:
        # The states of the pause wait in the socket, and reading one of them takes this much processor time.
        monkeypatch.setattr(time, "thread_time", itertools.count(step=read_time).__next__)
        at_full_speed(rig)
        before = rig.speed
        rig.node_runs = False
        # 0.14 s pass until the pause is noticed, and 0.2 s until the drone has turned; then it brakes with 6 m/s^2.
        rig.run(0.8)
        assert rig.speed < 0.4 * before
        rig.node_runs = True
        rig.run(0.5)
        # The failsafe process brakes until the node knows the motion of the drone.
        assert max(rig.tilts[-125:]) < math.radians(40.0)
        while rig.node.state is not State.ARRIVED:
            rig.run(0.1)
            assert rig.autopilot.mode is Mode.OFFBOARD and not rig.collided and rig.now < 40.0
        assert any("the control loop stalled" in str(change) for change in rig.node.changes)


def test_the_failsafe_process_brakes_around_an_obstacle_that_was_seen(planner: Planner):
    # A wall of posts across the way, with a gap to the left of the drone.
    wall = [(16.0, y) for y in np.arange(-3.0, 0.9, 0.5)]
    with LockstepRig(planner, avenue(*wall), seed=3, lidar=QUARTER) as rig:
        assert rig.take_over()
        while rig.autopilot.position[0] < 12.6:
            rig.run(0.02)
            assert rig.now < 20.0
        path = rig.node.schedule.path(0.0)
        assert path is not None and rig.speed > 2.5
        kill(rig)
        run_until_handed_back(rig)
        assert not rig.collided and rig.speed < 0.4
        # It has followed the planner's path.
        assert np.linalg.norm(rig.autopilot.position - path.positions[-1]) < 0.8


def test_a_pilot_who_takes_over_from_the_failsafe_process_is_left_alone(planner: Planner):
    with LockstepRig(planner, avenue(), seed=4, lidar=QUARTER) as rig:
        at_full_speed(rig)
        kill(rig)
        rig.run(0.3)
        rig.autopilot.hold()  # the pilot moves the switch
        rig.run(4.0)
        assert rig.autopilot.mode is Mode.HOLD and rig.autopilot.violations == [] and rig.speed < 0.1


def test_a_restarted_flight_gives_the_same_result(planner: Planner):
    def fly() -> np.ndarray:
        with LockstepRig(planner, avenue((8.0, 0.4)), seed=5, lidar=QUARTER) as rig:
            assert rig.take_over()
            rig.run(2.0)
            return rig.autopilot.position

    np.testing.assert_array_equal(fly(), fly())


def test_the_drone_stands_on_the_ground_until_it_is_armed_and_the_node_notes_its_height(planner: Planner):
    with LockstepRig(planner, avenue(), seed=6, lidar=QUARTER) as rig:
        rig.run(1.0)
        assert rig.autopilot.position[2] < 0.2 and not rig.autopilot.armed and rig.node.state is State.WAITING
        assert rig.node.ground.source is GroundSource.STANDING and abs(rig.node.ground.height) < 0.2
        assert rig.take_over()
        assert rig.autopilot.position[2] > 1.7


def test_a_node_that_continues_after_it_was_handed_back_sends_nothing(planner: Planner):
    # The messages that waited for it still say that the drone obeys it.
    with LockstepRig(planner, avenue(), seed=7, lidar=QUARTER) as rig:
        at_full_speed(rig)
        rig.node_runs = False
        rig.run(4.0)
        assert rig.autopilot.mode is Mode.HOLD
        sent = len(rig.autopilot.setpoints)
        rig.node_runs = True
        rig.run(1.0)
        assert rig.node.state is State.HANDED_BACK and len(rig.autopilot.setpoints) == sent
