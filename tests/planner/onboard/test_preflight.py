import dataclasses
import json
import math
import socket
import threading
from pathlib import Path

import numpy as np
import pytest

from aero_planner import Planner, PlannerConfig
from aero_planner.check_report import Check, CheckReport
from aero_planner.onboard.connections import open_lidar
from aero_planner.onboard.input_checks import check_inputs
from aero_planner.onboard.preflight import check_memory, check_thrust, check_tuning, preflight
from aero_planner.onboard.settings import OnboardConfig
from tests.planner.onboard.mavlink_peer import ARMED, Peer, mavlink, odometry
from tests.planner.onboard.simulated import PLACES, SMALL, Simulation, poles

FAST = SMALL.replace({"sampling.samples": 2, "sampling.steps": 8})


@pytest.fixture
def drone(small_planner: Planner) -> Simulation:
    """A drone whose node does nothing, so that only the checks read its inputs."""
    simulation = Simulation(small_planner, poles(PLACES), None)
    simulation.control_alive = simulation.planning_alive = False
    return simulation


def run_checks(drone: Simulation, config: OnboardConfig | None = None, **options) -> dict[str, Check]:
    checks = check_inputs(
        drone.link, drone.lidar, config or OnboardConfig(), clock=lambda: drone.now, sleep=drone.run, **options
    )
    return {check.name: check for check in checks}


def test_a_drone_in_order_passes(drone: Simulation):
    checks = run_checks(drone, goal=(18.0, 0.0, 2.0))
    assert all(check.ok for check in checks.values()), checks
    assert set(checks) == {
        "vehicle state", "heartbeat", "round trip", "vehicle mode", "landed state", "position uncertainty",
        "velocity uncertainty", "GNSS fix", "transmitter", "LiDAR", "cloud", "packets", "deskewing",
        "cloud against itself", "ground", "position", "goal",
    }  # fmt: skip
    assert "disarmed, not in OFFBOARD" in checks["vehicle mode"].finding
    assert not drone.link.sent  # nothing is commanded


def test_missing_inputs_fail(drone: Simulation):
    drone.link.alive = drone.lidar.alive = False
    checks = run_checks(drone)
    assert checks["vehicle state"].finding == checks["LiDAR"].finding == "nothing arrived"
    assert not checks["vehicle state"].ok and "mavlink.url" in checks["vehicle state"].advice
    assert not checks["LiDAR"].ok and "lidar.port" in checks["LiDAR"].advice
    assert not checks["goal"].ok and not checks["goal"].required
    config = OnboardConfig().replace({"lidar.source": "ros", "state.source": "ros", "lidar.topic": "/left/lidar"})
    checks = run_checks(drone, config)
    assert "ros2 topic hz /Odometry" in checks["vehicle state"].advice and "mavlink" in checks["vehicle state"].advice
    assert "ros2 topic hz /left/lidar" in checks["LiDAR"].advice and "port" not in checks["LiDAR"].advice


def test_only_the_faults_fail(drone: Simulation):
    drone.link.armed = True
    drone.lidar.counters.lost = 50
    checks = run_checks(drone, goal=(500.0, 0.0, 2.0))
    assert [name for name, check in checks.items() if not check.ok] == ["vehicle mode", "packets", "goal"]

    drone.link.armed, drone.lidar.counters.lost = False, 0
    drone.motion = dataclasses.replace(drone.motion, position=np.array([0.0, 200.0, 0.0]))
    drone.link.goal = np.array([1.0, 0.0, 2.0])
    checks = run_checks(drone)
    failed = [name for name, check in checks.items() if not check.ok]
    assert "position" in failed and "goal" not in failed  # on the ground, but outside; the goal came over the link


def test_a_poor_estimate_fails_and_an_unknown_one_is_a_warning(drone: Simulation):
    drone.link.position_std = 2.5
    checks = run_checks(drone)
    assert not checks["position uncertainty"].ok and checks["velocity uncertainty"].ok
    assert checks["position uncertainty"].finding == "2.50 m (standard deviation)"
    drone.link.position_std = drone.link.velocity_std = math.nan
    checks = run_checks(drone)
    for name in ("position uncertainty", "velocity uncertainty"):
        assert checks[name].finding == "not reported" and not checks[name].ok and not checks[name].required


@pytest.mark.parametrize(
    ("age", "finding", "is_ok", "is_required"),
    [(0.1, "0.1 s ago", True, True), (0.9, "0.9 s ago", False, True), (math.nan, "not reported", False, False)],
)
def test_a_lost_gnss_fix_fails_and_one_that_never_was_is_a_warning(
    drone: Simulation, age: float, finding: str, is_ok: bool, is_required: bool
):
    drone.link.fix_age = age
    check = run_checks(drone)["GNSS fix"]
    assert (check.finding, check.ok, check.required) == (finding, is_ok, is_required)


@pytest.mark.parametrize(
    ("round_trip", "finding", "is_ok", "is_required"),
    [(0.013, "13 ms to the autopilot and back", True, True), (0.3, "300 ms to the autopilot and back", False, True),
     (math.nan, "not measured", False, False)],
)  # fmt: skip
def test_a_late_link_fails_and_one_that_is_not_measured_is_a_warning(
    drone: Simulation, round_trip: float, finding: str, is_ok: bool, is_required: bool
):
    drone.link.round_trip = round_trip
    check = run_checks(drone)["round trip"]
    assert (check.finding, check.ok, check.required) == (finding, is_ok, is_required)


@pytest.mark.parametrize(("in_air", "passes"), [(True, True), (False, True), (None, False)])
def test_the_landed_state_must_be_reported(drone: Simulation, in_air: bool | None, passes: bool):
    drone.link.in_air = in_air
    check = run_checks(drone)["landed state"]
    assert check.ok is passes and (passes or "EXTENDED_SYS_STATE" in check.advice)


@pytest.mark.parametrize(
    ("transmitter", "battery_low", "failed"),
    [(None, False, ["transmitter"]), (False, False, ["transmitter"]), (True, True, ["battery"])],
)
def test_transmitter_and_battery_must_be_in_order(drone: Simulation, transmitter, battery_low, failed):
    drone.link.transmitter, drone.link.battery_low = transmitter, battery_low
    checks = run_checks(drone)
    assert [name for name in ("transmitter", "battery") if name in checks and not checks[name].ok] == failed


def test_a_low_floor_needs_a_distance_sensor(drone: Simulation):
    low = OnboardConfig().replace({"limits.fence_height_min": 0.4})
    check = run_checks(drone, low)["ground"]
    assert not check.ok and not check.required and "DISTANCE_SENSOR" in check.advice
    assert check.finding == "at a height of 0.00 m, assumed at the local origin; the floor is 0.4 m above it"
    drone.link.in_air = False
    check = run_checks(drone, low)["ground"]
    assert not check.ok and check.finding.startswith("at a height of 2.00 m, where the drone stood before the flight")
    drone.link.in_air, drone.link.ground_height = True, 0.3
    check = run_checks(drone, low)["ground"]
    assert check.ok and check.finding.startswith("at a height of 0.30 m, measured by the autopilot's distance sensor")


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.50"])
def test_beyond_loopback_the_sensors_address_is_required(host: str):
    config = OnboardConfig().replace({"lidar.host": host, "lidar.port": 0})
    with pytest.raises(ValueError, match=r"set lidar\.sensor to the sensor's address"):
        open_lidar(config)
    named = config.replace({"lidar.host": "0.0.0.0", "lidar.sensor": "192.168.1.142"})
    open_lidar(named).close()


def test_messages_from_unknown_senders_are_a_warning(drone: Simulation):
    drone.link.ignored["goal from 255@autopilot"] = 3
    check = run_checks(drone)["ignored messages"]
    assert check.finding == "3 x goal from 255@autopilot" and not check.ok and not check.required


def test_unusable_messages_are_a_warning(drone: Simulation):
    drone.link.dropped["ODOMETRY in frames 0 and 1"] = 300
    check = run_checks(drone)["unusable messages"]
    assert check.finding == "300 x ODOMETRY in frames 0 and 1" and not check.ok and not check.required


def test_a_sensor_that_sees_nothing_is_not_ready(drone: Simulation):
    drone.lidar.world = np.array([[500.0, 0.0, 0.0]] * 40, np.float32)
    checks = run_checks(drone)
    assert drone.lidar.counters.packets and not checks["LiDAR"].ok and not checks["cloud"].ok
    assert checks["cloud"].finding == "no points: covered, or nothing is in range"
    assert "fly only where something is in range" in checks["LiDAR"].advice


def test_late_and_infrequent_states_fail(drone: Simulation):
    drone.state_delay = 0.4
    checks = run_checks(drone)
    assert not checks["vehicle state"].ok and "The states are late" in checks["vehicle state"].advice
    assert checks["deskewing"].ok  # later poses place the points that waited

    drone.state_delay, drone.link.frozen = 0.0, True
    checks = run_checks(drone)
    assert not checks["vehicle state"].ok and checks["vehicle state"].finding.startswith("0 per second")
    assert "raise the autopilot's rate" in checks["vehicle state"].advice
    # Points that wait for a pose in vain are not placed.
    assert not checks["deskewing"].ok and checks["deskewing"].finding == "0 % of the points have a pose"


def test_the_complete_report(tmp_path: Path):
    config = OnboardConfig().replace(
        {
            "lidar.host": "127.0.0.1",
            "lidar.port": 0,
            "lidar.points_max": 2000,
            "mavlink.url": "udpin:127.0.0.1:0",
            "telemetry.port": 0,
        }
    )
    report = preflight(FAST, config, log=tmp_path, listen=0.1)
    found = {check.name: check for check in report.checks}
    failed = [check.name for check in report.checks if not check.ok and check.required]
    assert failed == ["vehicle state", "LiDAR"] and not report.passed
    assert found["warp-lang"].ok and found["pymavlink"].ok and found["mcap"].ok
    assert "plans 2800 points in" in found["device cpu"].finding
    assert str(tmp_path) in found["disk for the log"].finding and found["hover thrust"].ok
    content = json.loads(json.dumps(report.to_dict()))
    assert content["passed"] is False and len(content["checks"]) == len(report.checks)
    table = report.format_table()
    assert table.count("FAIL") == 2 and "-> Check the cable" in table and table.endswith("see above.")


@pytest.mark.parametrize(
    ("planner", "contradiction"),
    [
        (FAST, "the planner's horizon"),
        (FAST.replace({"vehicle.model": "acceleration"}), "vehicle.model is acceleration; the node commands thrust"),
    ],
)
def test_failures_before_the_inputs_are_checked(tmp_path: Path, planner: PlannerConfig, contradiction: str):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken, socket.create_server(("127.0.0.1", 0)) as viewer:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        config = OnboardConfig().replace(
            {
                "lidar.host": "127.0.0.1",
                "lidar.port": port,
                "lidar.points_max": 2000,
                "mavlink.url": f"udpin:127.0.0.1:{port}",
                "telemetry.port": viewer.getsockname()[1],
                "thrust.hover_thrust": 0.8,
                "limits.plan_age": 0.5,
            }
        )
        report = preflight(planner, config, device="cuda:7", log=tmp_path / "absent" / "a.mcap", listen=0.1)
    found = {check.name: check for check in report.checks}
    for name in ("configuration", "device cuda:7", "hover thrust", "autopilot port", "LiDAR port", "disk for the log"):
        assert not found[name].ok and found[name].required, name
    assert contradiction in found["configuration"].finding
    assert "vehicle.thrust_max" in found["hover thrust"].advice
    assert "lidar.port" in found["LiDAR port"].finding and "in use" in found["LiDAR port"].finding
    assert not found["telemetry port"].ok and not found["telemetry port"].required
    assert "vehicle state" not in found


def test_parameters_are_not_written_to_a_vehicle_that_is_armed_before_the_answer(port: int):
    """The autopilot reports one wrong parameter, and is armed while the user is asked."""
    settings = {"lidar.host": "127.0.0.1", "lidar.port": 0, "lidar.points_max": 2000, "telemetry.enabled": False}
    config = OnboardConfig().replace({**settings, "mavlink.url": f"udpin:127.0.0.1:{port}"})
    peer, is_armed, is_over = Peer(port), threading.Event(), threading.Event()
    written: list[str] = []

    def serve() -> None:
        while not is_over.wait(0.02):
            peer.send(odometry())
            peer.heartbeat(ARMED if is_armed.is_set() else 0, 0)
            for message in peer.received("PARAM_REQUEST_READ", "PARAM_SET"):
                name = message.param_id
                written.extend([name] if message.get_type() == "PARAM_SET" else [])
                value = {"COM_OF_LOSS_T": 1.0}.get(name, 0.0)
                peer.send(mavlink.MAVLink_param_value_message(name.encode(), value, 9, 1000, 7))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        report = preflight(FAST, config, listen=2.0, confirm=lambda changes: is_armed.set() or bool(changes))
    finally:
        is_over.set()
        thread.join()
        peer.socket.close()
    check = next(check for check in report.checks if check.name == "parameters")
    assert not written and not check.ok and "disarm it" in check.advice
    assert check.finding.startswith("the vehicle is armed; not written: COM_OF_LOSS_T")


def test_a_thrust_curve_comes_with_a_note_on_compensation():
    linear, curved = (check_thrust(SMALL, OnboardConfig().replace({"thrust.curve": curve})) for curve in (0.0, 0.5))
    # 1 kg hovers at half the throttle: with a curve of 0.5 that is 0.5 x 0.5 + 0.5 x 0.25 of the full thrust.
    assert linear.finding == "hovers at 0.5 with 9.8 N: at most 19.6 N, 2.0 times the weight"
    assert "valid only if THR_MDL_FAC is 0: at most 26.2 N" in curved.finding


def test_a_report_passes_if_all_required_checks_do():
    good, warning = Check("a", "yes"), Check("b", "no", ok=False, required=False, advice="Do it.")
    assert CheckReport((good, warning)).passed
    assert "warn  b  no" in CheckReport((good, warning)).format_table()
    assert not CheckReport((good, dataclasses.replace(warning, required=True))).passed


def test_a_drone_that_may_become_slower_needs_the_memory_of_the_slowest():
    onboard = OnboardConfig().replace({"lidar.older_sweeps": 20, "tuning.limits": "vehicle.speed_limit 1..7"})
    check = check_memory(SMALL.replace({"vehicle.speed_limit": 7.0}), onboard)
    assert not check.ok and "At a limit of 1 m/s" in check.advice and "set lidar.older_sweeps to 80" in check.advice


def test_key_and_limits_of_the_tuning_are_checked(tmp_path: Path):
    key = tmp_path / "key"
    key.write_text("0" * 64)
    limits = "costs.q_track 1..30"
    for key_file, allowed, is_required, is_ok in (
        (key, limits, False, True), (key, "none", False, False), ("none", limits, False, False),
        (tmp_path / "missing", limits, True, False),
    ):  # fmt: skip
        settings = {"tuning.key_file": str(key_file), "tuning.limits": allowed}
        (check,) = check_tuning(OnboardConfig().replace(settings))
        assert (check.required, check.ok) == (is_required, is_ok), check
    assert "can't read the key" in check.finding and "tuning.key_file" in check.finding
    assert list(check_tuning(OnboardConfig())) == []


@pytest.mark.parametrize(
    ("limit", "older", "advised"), [(7.0, 20, None), (7.0, 19, 20), (1.0, 20, 80), (1.0, 80, None), (0.5, 100, None)]
)
def test_a_slow_drone_needs_a_longer_memory(limit: float, older: int, advised: int | None):
    planner = SMALL.replace({"vehicle.speed_limit": limit})
    check = check_memory(planner, OnboardConfig().replace({"lidar.older_sweeps": older}))
    assert check.finding == f"the cloud reaches back {1.0 + 0.1 * older:.1f} s, {10 + older} sweeps"
    assert check.ok is (advised is None) and not check.required
    assert advised is None or f"set lidar.older_sweeps to {advised} or more" in check.advice
