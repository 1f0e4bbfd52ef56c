"""The other end of a MAVLink connection, and messages of an autopilot."""

import math
import socket
from typing import Any

from aero_planner.onboard.mavlink_sender import load_dialect

mavlink = load_dialect()
HALF = math.sqrt(0.5)
NAN21 = [math.nan] * 21
ARMED = mavlink.MAV_MODE_FLAG_SAFETY_ARMED | mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24


class Peer:
    """The other end of a link."""

    def __init__(self, url_port, system=1, component=1):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.address = ("127.0.0.1", url_port)
        self.protocol = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.parser = mavlink.MAVLink(None)

    def send(self, *messages):
        self.socket.sendto(b"".join(bytes(m.pack(self.protocol)) for m in messages), self.address)

    def heartbeat(self, base=ARMED, mode=OFFBOARD, *, autopilot=mavlink.MAV_AUTOPILOT_PX4, kind=2):
        self.send(mavlink.MAVLink_heartbeat_message(kind, autopilot, base, mode, 4, 3))

    def received(self, *names):
        messages = []
        while True:
            try:
                messages += self.parser.parse_buffer(self.socket.recv(2048)) or []
            except BlockingIOError:
                return [m for m in messages if m.get_type() in names]


def odometry(
    p=(0, 0, 0), q=(1, 0, 0, 0), v=(0, 0, 0), *, time=5.0, frame=1, child=1, resets=0, variances=(NAN21, NAN21)
):
    values = [*map(float, p), list(map(float, q)), *map(float, v), 0.0, 0.0, 0.0]
    return mavlink.MAVLink_odometry_message(int(1e6 * time), frame, child, *values, *variances, resets, 0)


def landed_state(state):
    return mavlink.MAVLink_extended_sys_state_message(0, state)


def local_position(p, v, time):
    return mavlink.MAVLink_local_position_ned_message(int(1e3 * time), *map(float, p), *map(float, v))


def attitude(q, rates, time):
    return mavlink.MAVLink_attitude_quaternion_message(int(1e3 * time), *map(float, q), *map(float, rates))


def goal_message(p, *, system=1, component=191, mask=0b110111111000, frame=1):
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, component, frame, mask, *map(float, p), *[0.0] * 8
    )


def mission_item(
    seq, place=(0, 0, 0), *, command=mavlink.MAV_CMD_NAV_WAYPOINT, hold=0.0, radius=0.0, param1=None, param3=0.0,
    frame=mavlink.MAV_FRAME_LOCAL_NED, scale=1e4, autocontinue=1,
):  # fmt: skip
    """Return a MISSION_ITEM_INT; `hold` is param1 and `radius` param2."""
    first = hold if param1 is None else param1
    x, y = (round(scale * value) for value in place[:2])
    return mavlink.MAVLink_mission_item_int_message(
        1, 191, seq, frame, command, 0, autocontinue, first, radius, param3, math.nan, x, y, float(place[2])
    )


def state_after(link, autopilot, *messages) -> Any:
    autopilot.send(*messages)
    link.poll()
    return None if link.state is None else link.state.state


def gnss(fix_type):
    return mavlink.MAVLink_gps_raw_int_message(0, fix_type, 0, 0, 0, 0, 0, 0, 0, 0)


def transmitter(present):
    sensors = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if present else 0
    return mavlink.MAVLink_sys_status_message(sensors, 0, 0, 0, 0, -1, -1, *[0] * 6)


def battery(charge_state, number=0):
    return mavlink.MAVLink_battery_status_message(number, 0, 0, 0, [65535] * 10, -1, -1, -1, -1, 0, charge_state)


def distance(centimetres, *, orientation=25, quality=0):
    return mavlink.MAVLink_distance_sensor_message(
        0, 20, 1000, centimetres, 0, 0, orientation, 0, 0.0, 0.0, [0.0] * 4, quality
    )
