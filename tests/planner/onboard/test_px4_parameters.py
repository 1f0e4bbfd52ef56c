"""PX4's parameters, with a pymavlink peer that answers as PX4 does."""

import math
import socket
import struct

import pytest

from aero_planner.config import VehicleConfig
from aero_planner.onboard.connections import open_link
from aero_planner.onboard.mavlink_sender import load_dialect
from aero_planner.onboard.px4_parameters import (
    ParameterChange,
    WriteResult,
    check_parameters,
    find_changes,
    parameter_names,
    read_parameters,
    write_parameters,
)
from aero_planner.onboard.settings import OnboardConfig

mavlink = load_dialect()
NAN21 = [math.nan] * 21
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
CHANGE = ParameterChange("NAV_RCL_ACT", 1, 2)
DEFAULTS = {
    "COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 0, "COM_RC_OVERRIDE": 1, "COM_RCL_EXCEPT": 0, "NAV_RCL_ACT": 2,
    "NAV_DLL_ACT": 0, "COM_LOW_BAT_ACT": 0, "BAT_CRIT_THR": 0.07, "COM_FAIL_ACT_T": 5.0,
    "COM_FLTT_LOW_ACT": 0, "COM_FLT_TIME_MAX": -1, "GF_ACTION": 2, "COM_WIND_MAX_ACT": 0, "COM_IMB_PROP_ACT": 0,
    "COM_ACT_FAIL_ACT": 0,
    "THR_MDL_FAC": 0.0, "MPC_THR_HOVER": 0.5, "MAV_1_FORWARD": 0,
}  # fmt: skip
"""PX4's defaults."""


class Px4:
    """Serves parameters and sends a heartbeat per second; drops every third request, as a poor link would."""

    def __init__(self, parameters: dict[str, float | int], base_mode: int = 0) -> None:
        self.parameters = dict(parameters)
        self.now = 100.0
        self.base_mode = base_mode
        self.has_heartbeat = True
        self.requests = 0
        self.set_requests = 0
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(60.0)
        self.protocol = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        url = f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"
        self.link = open_link(OnboardConfig().replace({"mavlink.url": url}), VehicleConfig(), clock=self.clock)
        self.link.poll()
        _, self.peer = self.socket.recvfrom(2048)
        self.socket.setblocking(False)
        self.send_heartbeat()
        position = [0.0] * 3, [1.0, 0.0, 0.0, 0.0], [0.0] * 6
        self.send(mavlink.MAVLink_odometry_message(1, 1, 1, *position[0], position[1], *position[2], NAN21, NAN21))
        self.link.poll()

    def send(self, message) -> None:
        self.socket.sendto(bytes(message.pack(self.protocol)), self.peer)

    def send_heartbeat(self) -> None:
        self.heartbeat_time = self.now
        self.send(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, self.base_mode, 0, 4, 3))

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass and answer what has arrived."""
        self.now += seconds
        if self.has_heartbeat and self.now - self.heartbeat_time >= 1.0:
            self.send_heartbeat()
        while True:
            try:
                data = self.socket.recv(2048)
            except BlockingIOError:
                return
            for message in self.protocol.parse_buffer(data) or []:
                self.answer(message)

    def answer(self, message) -> None:
        if message.get_type() not in ("PARAM_REQUEST_READ", "PARAM_SET"):
            return
        self.requests += 1
        self.set_requests += message.get_type() == "PARAM_SET"
        name = message.param_id
        if self.requests % 3 == 1 or name not in self.parameters:
            return
        is_integer = isinstance(self.parameters[name], int)
        if message.get_type() == "PARAM_SET":
            assert message.param_type == (mavlink.MAV_PARAM_TYPE_INT32 if is_integer else mavlink.MAV_PARAM_TYPE_REAL32)
            bits = struct.pack("<f", message.param_value)
            self.parameters[name] = struct.unpack("<i" if is_integer else "<f", bits)[0]
        value = self.parameters[name]
        content = struct.unpack("<f", struct.pack("<i", value))[0] if is_integer else value
        kind = mavlink.MAV_PARAM_TYPE_INT32 if is_integer else mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_value_message(name.encode(), content, kind, 1000, 7))

    def read(self, names) -> dict[str, float]:
        return read_parameters(self.link, names, clock=self.clock, sleep=self.sleep)

    def write(self, changes) -> WriteResult:
        return write_parameters(self.link, changes, clock=self.clock, sleep=self.sleep)

    def close(self) -> None:
        self.link.close()
        self.socket.close()


@pytest.fixture
def connect():
    opened = []

    def connect(*arguments) -> Px4:
        opened.append(Px4(*arguments))
        return opened[-1]

    yield connect
    for px4 in opened:
        px4.close()


def test_floats_and_integers_are_read_over_a_poor_link(connect):
    px4 = connect({"A_FLOAT": 0.25, "AN_INT": 7, "A_NEGATIVE_INT": -3, "SIXTEEN_LETTERS_": 5})
    read = px4.read(["A_FLOAT", "AN_INT", "A_NEGATIVE_INT", "SIXTEEN_LETTERS_", "ABSENT"])
    assert read == {"A_FLOAT": 0.25, "AN_INT": 7.0, "A_NEGATIVE_INT": -3.0, "SIXTEEN_LETTERS_": 5.0}
    assert px4.now == pytest.approx(102.0, abs=0.1)  # it waits two seconds for the absent one, no longer


def test_px4s_defaults_are_found_wanting_and_repaired(connect):
    px4, config = connect(DEFAULTS), OnboardConfig().replace({"thrust.hover_thrust": 0.42})
    values = px4.read(parameter_names(config))
    checks = {check.name: check for check in check_parameters(values, config)}
    failed = {name for name, check in checks.items() if not check.ok and check.required}
    assert failed == {"COM_OF_LOSS_T", "COM_RC_OVERRIDE", "COM_RCL_EXCEPT", "NAV_RCL_ACT"}
    assert checks["COM_OF_LOSS_T"].finding == "1; wanted: 0.18 to 0.5 s"
    assert "climbs to 30 m" in checks["NAV_RCL_ACT"].advice and "Set it to 1" in checks["NAV_RCL_ACT"].advice
    hover = checks["MPC_THR_HOVER"]
    assert not hover.ok and not hover.required and hover.finding == "0.5; wanted: 0.42, as thrust.hover_thrust"
    changes = find_changes(values, config)
    assert {change.name: (change.before, change.value) for change in changes} == {
        "COM_OF_LOSS_T": (1.0, 0.2), "COM_RC_OVERRIDE": (1, 3), "COM_RCL_EXCEPT": (0, 4), "NAV_RCL_ACT": (2, 1),
    }  # fmt: skip
    assert px4.write(changes) == WriteResult(())
    assert px4.parameters["COM_RC_OVERRIDE"] == 3 and px4.parameters["COM_OF_LOSS_T"] == pytest.approx(0.2)
    values = px4.read(parameter_names(config))
    assert find_changes(values, config) == []
    assert all(check.ok or not check.required for check in check_parameters(values, config))


def test_a_refused_change_is_named(connect):
    px4 = connect({"NAV_RCL_ACT": 2})
    values = px4.read(["NAV_RCL_ACT"])
    del px4.parameters["NAV_RCL_ACT"]
    assert px4.write([ParameterChange("NAV_RCL_ACT", 1, values["NAV_RCL_ACT"])]) == WriteResult(("NAV_RCL_ACT",))


def test_nothing_is_written_to_a_vehicle_that_was_armed_while_the_user_was_asked(connect):
    px4 = connect(DEFAULTS)
    px4.send_heartbeat()  # still waits, unread, when the answer comes
    px4.base_mode = ARMED
    assert px4.write([CHANGE]) == WriteResult(("NAV_RCL_ACT",), "the vehicle is armed")
    px4.sleep(0.1)
    assert px4.set_requests == 0


def test_writing_ends_when_the_vehicle_is_armed(connect):
    px4 = connect({"NAV_RCL_ACT": 2})
    px4.read(["NAV_RCL_ACT"])
    del px4.parameters["NAV_RCL_ACT"]  # so that the request is repeated

    def arm_after_the_first_request(seconds: float) -> None:
        if px4.set_requests == 1 and px4.base_mode != ARMED:
            px4.base_mode = ARMED
            px4.send_heartbeat()
        px4.sleep(seconds)

    result = write_parameters(px4.link, [CHANGE], clock=px4.clock, sleep=arm_after_the_first_request)
    assert result == WriteResult(("NAV_RCL_ACT",), "the vehicle is armed") and px4.set_requests == 1


def test_nothing_is_written_without_heartbeats(connect):
    px4 = connect(DEFAULTS)
    px4.has_heartbeat = False
    result = px4.write([CHANGE])
    assert result.unconfirmed == ("NAV_RCL_ACT",) and "no heartbeat arrives" in result.refusal
    assert px4.set_requests == 0 and px4.now == pytest.approx(103.0, abs=0.1)


def test_the_wanted_values_follow_the_settings(connect):
    config = OnboardConfig().replace(
        {"limits.deadline": 0.5, "thrust.curve": 0.3, "mavlink.goal_senders": "vehicle,255@autopilot"}
    )
    checks = {check.name: check for check in check_parameters({**DEFAULTS, "THR_MDL_FAC": 0.2}, config)}
    assert checks["COM_OF_LOSS_T"].finding == "1; wanted: 0.58 to 0.58 s"
    assert not checks["THR_MDL_FAC"].ok and "thrust.curve to 0" in checks["THR_MDL_FAC"].advice
    assert not checks["MAV_1_FORWARD"].ok and not checks["MAV_1_FORWARD"].required
    assert "MAV_1_FORWARD" not in parameter_names(OnboardConfig())


def test_a_parameter_that_is_not_reported_is_a_warning():
    checks = list(check_parameters({}, OnboardConfig()))
    assert checks and all(check.finding == "not reported" and not check.required for check in checks)
    assert find_changes({}, OnboardConfig()) == []


@pytest.mark.parametrize(
    ("name", "wrong", "repaired", "is_required"),
    [
        ("NAV_DLL_ACT", 2, 0, True),  # Return
        ("COM_LOW_BAT_ACT", 3, None, True),  # Return, then Land
        ("COM_LOW_BAT_ACT", 1, None, True),
        ("COM_FLTT_LOW_ACT", 3, 1, True),  # Return
        ("COM_FLT_TIME_MAX", 600, -1, True),
        ("GF_ACTION", 3, 2, True),
        ("GF_ACTION", 4, 2, True),  # ends the flight
        ("COM_WIND_MAX_ACT", 3, 1, True),
        ("COM_IMB_PROP_ACT", 1, 0, True),
        ("COM_ACT_FAIL_ACT", 3, 0, True),
        ("COM_FAIL_ACT_T", 0.0, 5.0, False),
    ],
)
def test_no_other_failsafe_of_px4_may_lead_the_drone_through_the_trees(name, wrong, repaired, is_required):
    values = {**DEFAULTS, name: wrong}
    check = next(check for check in check_parameters(values, OnboardConfig()) if check.name == name)
    assert not check.ok and check.required is is_required
    changes = {change.name: change.value for change in find_changes(values, OnboardConfig())}
    assert changes.get(name) == repaired
    right = next(check for check in check_parameters(DEFAULTS, OnboardConfig()) if check.name == name)
    assert right.ok
