"""Vehicles that are no PX4 multicopter: preflight refuses them, and nothing is sent to them."""

import threading

import pytest

from aero_planner import Planner
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.preflight import preflight
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.mavlink_peer import ARMED, OFFBOARD, Peer, landed_state, mavlink, odometry, state_after
from tests.planner.onboard.simulated import GOAL, SMALL, WORLD, Simulation, in_flight

GUIDED = 4
"""Custom mode of ArduCopter, whose base mode has the same flags."""
OTHERS = [
    (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_QUADROTOR, GUIDED, "ARDUPILOTMEGA QUADROTOR"),
    (mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mavlink.MAV_TYPE_QUADROTOR, OFFBOARD, "ARDUPILOTMEGA QUADROTOR"),
    (mavlink.MAV_AUTOPILOT_GENERIC, mavlink.MAV_TYPE_QUADROTOR, OFFBOARD, "GENERIC QUADROTOR"),
    (mavlink.MAV_AUTOPILOT_INVALID, mavlink.MAV_TYPE_GCS, OFFBOARD, "INVALID GCS"),
    (250, mavlink.MAV_TYPE_HEXAROTOR, OFFBOARD, "250 HEXAROTOR"),
    (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_FIXED_WING, OFFBOARD, "PX4 FIXED_WING"),
    (mavlink.MAV_AUTOPILOT_PX4, mavlink.MAV_TYPE_VTOL_TILTROTOR, OFFBOARD, "PX4 VTOL_TILTROTOR"),
    (mavlink.MAV_AUTOPILOT_PX4, 199, OFFBOARD, "PX4 199"),
]


@pytest.mark.parametrize(("autopilot_id", "kind", "mode", "name"), OTHERS)
def test_another_vehicle_gets_no_message(link, autopilot, clock, autopilot_id, kind, mode, name):
    for k in range(30):
        clock.now += 0.1
        autopilot.heartbeat(mode=mode, autopilot=autopilot_id, kind=kind)
        state_after(link, autopilot, odometry(time=5.0 + 0.1 * k), landed_state(2))
        link.send([9.81, 0, 0, 0])
        link.request_parameter("COM_OF_LOSS_T")
    assert autopilot.received("SET_ATTITUDE_TARGET", "COMMAND_LONG", "PARAM_REQUEST_READ", "HEARTBEAT") == []
    assert link.sent == 0 and not link.state.supported and link.vehicle_kind == name


@pytest.mark.parametrize(("autopilot_id", "kind", "mode", "name"), OTHERS)
def test_one_that_shares_the_ids_of_a_px4_ends_the_commands_for_good(
    link, autopilot, autopilot_id, kind, mode, name, caplog
):
    autopilot.heartbeat()
    state_after(link, autopilot, odometry())
    link.send([9.81, 0, 0, 0])
    assert link.state.supported and len(autopilot.received("SET_ATTITUDE_TARGET")) == 1
    for _ in range(3):  # both answer in turn
        autopilot.heartbeat(mode=mode, autopilot=autopilot_id, kind=kind)
        autopilot.heartbeat()
        link.poll()
        link.send([9.81, 0, 0, 0])
        assert not link.state.supported and link.vehicle_kind == name
    assert autopilot.received("SET_ATTITUDE_TARGET") == []
    assert [record.levelname for record in caplog.records].count("ERROR") == 1


def test_other_vehicles_and_components_beside_a_px4_change_nothing(link, autopilot):
    autopilot.heartbeat()
    state_after(link, autopilot, odometry())
    for system, component in [(2, 1), (1, 154), (255, 190), (1, 191)]:
        protocol = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        message = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, ARMED, GUIDED, 4, 3)
        autopilot.socket.sendto(bytes(message.pack(protocol)), autopilot.address)  # a router in between
    link.poll()
    link.send([9.81, 0, 0, 0])
    assert link.state.supported and link.vehicle_kind == "PX4 QUADROTOR"
    assert len(autopilot.received("SET_ATTITUDE_TARGET")) == 1


def test_in_flight_not_even_a_last_command_is_sent(small_planner: Planner):
    flight = in_flight(small_planner)
    sent = len(flight.link.sent)
    flight.link.supported = False
    flight.run(0.02)
    assert flight.node.state is State.HANDED_BACK
    flight.link.supported = True
    flight.run(1.0)
    assert len(flight.link.sent) == sent and flight.node.state is State.HANDED_BACK


def test_before_a_take_over_it_prevents_ready(small_planner: Planner):
    simulation = Simulation(small_planner, WORLD, GOAL, changes={"limits.join_armed": True})
    simulation.link.armed = True
    assert simulation.run_until(lambda: simulation.node.state is State.READY, 1.0)
    simulation.link.supported = False
    sent = len(simulation.link.sent)
    simulation.run(0.5)
    assert simulation.node.state is State.WAITING and len(simulation.link.sent) == sent
    assert simulation.node.safety.missing() == (Cause.UNSUPPORTED,)


@pytest.mark.parametrize(("autopilot_id", "kind", "mode", "name"), OTHERS[:1] + OTHERS[5:6])
def test_preflight_refuses_it_and_neither_reads_nor_writes_parameters(port, autopilot_id, kind, mode, name):
    settings = {"lidar.host": "127.0.0.1", "lidar.port": 0, "lidar.points_max": 2000, "telemetry.enabled": False}
    config = OnboardConfig().replace({**settings, "mavlink.url": f"udpin:127.0.0.1:{port}"})
    peer, is_over = Peer(port), threading.Event()

    def serve() -> None:
        while not is_over.wait(0.02):
            peer.heartbeat(0, mode, autopilot=autopilot_id, kind=kind)
            peer.send(odometry())

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        planner = SMALL.replace({"sampling.samples": 2, "sampling.steps": 8})
        report = preflight(planner, config, listen=0.3, confirm=lambda _: True)
    finally:
        is_over.set()
        thread.join()
    check = next(check for check in report.checks if check.name == "autopilot")
    assert not check.ok and check.required and not report.passed
    assert check.finding.startswith(f"{name} at 127.0.0.1:") and "only a PX4" in check.advice
    assert peer.received("SET_ATTITUDE_TARGET", "COMMAND_LONG", "PARAM_REQUEST_READ", "PARAM_SET") == []
    assert "COM_OF_LOSS_T" not in {check.name for check in report.checks}
    peer.socket.close()
