"""A mission in the node: what it tells its observers, and when it takes one."""

import contextlib
from pathlib import Path

import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.mission_progress import MissionEvent
from aero_planner.missions import Mission, Waypoint
from aero_planner.onboard.failsafe_table import State
from aero_planner.onboard.flight_log import FlightLog
from aero_planner.onboard.interfaces import Observation, Observer, PlanRecord
from aero_planner.onboard.mission_offer import MissionOffer
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.telemetry import Telemetry
from aero_planner.onboard.telemetry_protocol import Kind, Message
from tests.planner.onboard.simulated import CORRIDOR, Clock, Simulation, poles
from tests.planner.onboard.test_telemetry import Viewer

MISSION = Mission((Waypoint((6.0, 0.0, 2.0), speed=2.0), Waypoint((12.0, 0.0, 2.0), stop=True)))
EVENT = MissionEvent(12.5, 0, "passed", 0.2, "Waypoint 1 of 2 at (6, 0, 2) was passed after 12.50 s, 0.20 m from it.")


class Seen(Observer):
    """Keeps what a node reports about its mission."""

    def __init__(self) -> None:
        self.events: list[MissionEvent] = []
        self.indices: list[int] = []

    def observe(self, item: Observation) -> None:
        if isinstance(item, MissionEvent):
            self.events.append(item)
        elif isinstance(item, PlanRecord) and item.mission is not None:
            self.indices.append(item.mission.index)


def test_a_mission_is_flown_and_refused_while_the_drone_brakes(small_planner: Planner):
    seen = Seen()
    simulation = Simulation(small_planner, poles(CORRIDOR), MISSION, observers=[seen])
    simulation.engage()
    assert simulation.run_until(lambda: simulation.motion.position[0] > 4.0, 8.0)
    assert simulation.motion.speed < 2.5 and small_planner.config.vehicle.speed_limit == 2.0
    assert simulation.run_until(lambda: simulation.node.state is State.ARRIVED, 12.0)
    assert [(event.waypoint, event.kind) for event in seen.events] == [(0, "passed"), (1, "stopped")]
    assert seen.indices == sorted(seen.indices) and {0, 1} <= set(seen.indices)
    assert simulation.link.progress is not None and simulation.link.progress.is_over
    simulation.link.offer = MissionOffer(Mission.to_goal((2.0, 0.0, 2.0)))
    simulation.run(0.1)
    assert simulation.link.offer.answer == "" and simulation.node.state is State.FLYING
    simulation.lidar.alive = False
    assert simulation.run_until(lambda: simulation.node.state is State.BRAKING, 2.0)
    simulation.link.offer = MissionOffer(MISSION)
    simulation.run(0.04)
    assert str(simulation.link.offer.answer).startswith("the drone is braking: ")


def test_events_reach_viewers(clock: Clock):
    onboard = OnboardConfig().replace({"telemetry.port": 0})
    with contextlib.closing(Telemetry(PlannerConfig(), onboard, clock=clock)) as telemetry:
        viewer = Viewer(telemetry.port)
        assert viewer.read() is not None
        telemetry.observe(EVENT)
        message = viewer.read()
        assert isinstance(message, Message) and message.kind == Kind.EVENT
        assert MissionEvent.from_dict(message.values) == EVENT
        viewer.socket.close()


def test_events_are_logged(tmp_path: Path, clock: Clock):
    reader = pytest.importorskip("mcap.reader")
    log = FlightLog(tmp_path / "flight.mcap", PlannerConfig(), OnboardConfig(), clock=clock)
    log.observe(EVENT)
    log.close()
    with log.path.open("rb") as file:
        ((schema, channel, message),) = reader.make_reader(file).iter_messages()
    assert (schema.name, channel.topic) == ("std_msgs/msg/String", "/mission")
    assert EVENT.text.encode() in message.data
