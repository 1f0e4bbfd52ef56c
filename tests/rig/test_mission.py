"""A mission that a ground station sends over MAVLink, flown in simulated time."""

import contextlib
from collections.abc import Iterator

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.onboard.failsafe_table import State
from aero_viz.rig.lockstep import LockstepRig
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel
from tests.planner.onboard.mavlink_peer import Peer, mavlink, mission_item

CONFIG = PlannerConfig.preset("fast-cpu").replace({"vehicle.speed_limit": 5.0})
QUARTER = LidarModel("quarter", pattern="livox", points_per_sweep=5000)
SLOW = 2.0
ITEMS = [
    mission_item(0, (9, -1, -2), radius=1.0),
    mission_item(1, command=mavlink.MAV_CMD_DO_CHANGE_SPEED, param1=1.0, radius=SLOW),
    mission_item(2, (15, 1, -2), radius=1.0),
    mission_item(3, command=mavlink.MAV_CMD_DO_CHANGE_SPEED, param1=1.0, radius=24.0),
    mission_item(4, (25, 0, -2)),
]


@pytest.fixture
def planner() -> Iterator[Planner]:
    with contextlib.closing(Planner(CONFIG, device="cpu", threads=1)) as planner:
        yield planner


def avenue() -> World:
    posts = [[x, y, 0, 0, 0, 1, 0.3, 8] for x in range(0, 40, 3) for y in (-3.5, 3.5)]
    ground = [15.0, 0, -0.5, 120, 80, 1, 0]
    return World("avenue", np.array([0.0, 0, 2]), np.array([30.0, 0, 2]), np.array(posts), np.array([ground]))


def test_three_waypoints_are_passed_in_order_at_the_speeds_of_their_legs(planner: Planner):
    with LockstepRig(planner, avenue(), seed=1, lidar=QUARTER) as rig:
        assert rig.take_over()
        station = Peer(int(rig.node.config.mavlink.url.rpartition(":")[2]), 255, 190)
        station.send(mavlink.MAVLink_mission_count_message(1, 191, len(ITEMS)))
        results, reached, slow = [], [], []
        while len(reached) < 3:
            rig.run(0.02)
            for message in station.received("MISSION_REQUEST_INT", "MISSION_ACK", "MISSION_ITEM_REACHED"):
                if message.get_type() == "MISSION_REQUEST_INT":
                    station.send(ITEMS[message.seq])
                elif message.get_type() == "MISSION_ACK":
                    results.append(message.type)
                else:
                    reached.append(message.seq)
            if reached == [0]:
                slow.append(rig.speed)
            assert rig.now < 40.0 and not rig.collided
        assert results == [mavlink.MAV_MISSION_ACCEPTED] and reached == [0, 2, 4]
        assert max(rig.speeds) > 3.5, "the other legs are flown at the node's own limit, not at 24 m/s"
        assert max(rig.speeds) < 5.5 and max(slow[-30:]) < 1.25 * SLOW
        rig.run(1.0)
        assert rig.node.state is State.ARRIVED
        assert np.linalg.norm(rig.autopilot.position - [25.0, 0.0, 2.0]) < 0.6
        station.socket.close()
