"""A program that starts and speaks like PX4, without its vehicle: slow heartbeats, and an origin that is sent once.

It listens where PX4 does, and its time passes at PX4_SIM_SPEED_FACTOR.
"""

import contextlib
import os
import socket
import struct
import sys
import time

from aero_planner.onboard.mavlink_sender import load_dialect

mavlink = load_dialect()
HOST = "127.0.0.1"
ORIGIN = 473977420, 85455940, 488500
"""Latitude and longitude [1e-7 deg] and altitude [mm]."""
PARAMETERS: dict[str, float | int] = {
    "COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": 2, "COM_RC_OVERRIDE": 1, "COM_RCL_EXCEPT": 0, "NAV_RCL_ACT": 2,
    "THR_MDL_FAC": 0.0, "MPC_THR_HOVER": 0.5, "MIS_TAKEOFF_ALT": 2.5,
    "SIM_BAT_MIN_PCT": 50.0, "SIM_BAT_DRAIN": 60.0, "BAT_LOW_THR": 0.15, "SIM_GPS_USED": 10,
}  # fmt: skip
"""Wrong, as in a PX4 that was just built."""


class Endpoint:
    """One of PX4's MAVLink connections."""

    def __init__(self, port: int, system: int, remote: tuple[str, int] | None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((HOST, port))
        self.socket.setblocking(False)
        self.remote = remote
        self.protocol = mavlink.MAVLink(None, srcSystem=system, srcComponent=1)
        self.protocol.robust_parsing = True

    def send(self, message) -> None:
        if self.remote is not None:
            with contextlib.suppress(OSError):  # nobody listens yet
                self.socket.sendto(bytes(message.pack(self.protocol)), self.remote)

    def receive(self) -> list:
        messages = []
        while True:
            try:
                data, sender = self.socket.recvfrom(2048)
            except OSError:
                return messages
            if self.remote is None:
                self.remote = sender
            messages += self.protocol.parse_buffer(data) or []


def parameter_message(name: str):
    value, kind = PARAMETERS[name], mavlink.MAV_PARAM_TYPE_REAL32
    if isinstance(value, int):
        value, kind = struct.unpack("<f", struct.pack("<i", value))[0], mavlink.MAV_PARAM_TYPE_INT32
    return mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(PARAMETERS), 0)


def answer(endpoint: Endpoint, message, streams: set[int]) -> None:
    kind = message.get_type()
    if kind == "PARAM_REQUEST_READ" and message.param_id in PARAMETERS:
        endpoint.send(parameter_message(message.param_id))
    elif kind == "PARAM_SET" and message.param_id in PARAMETERS:
        is_integer = message.param_type == mavlink.MAV_PARAM_TYPE_INT32
        bits = struct.pack("<f", message.param_value)
        PARAMETERS[message.param_id] = struct.unpack("<i", bits)[0] if is_integer else message.param_value
        endpoint.send(parameter_message(message.param_id))
    elif kind == "COMMAND_LONG" and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
        streams.add(int(message.param1))  # but PX4 sends the origin only when it changes
    elif kind == "COMMAND_LONG" and (message.command, message.param1) == (
        mavlink.MAV_CMD_REQUEST_MESSAGE,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
    ):
        endpoint.send(mavlink.MAVLink_gps_global_origin_message(*ORIGIN))


def main(instance: int) -> None:
    if is_lame := "SIMULATOR_FAILS" in os.environ:  # as where a command of the start-up script fails
        print("ERROR [simulator_sih] Task start failed\nINFO  [px4] Startup script returned successfully", flush=True)
    speed, start = float(os.environ.get("PX4_SIM_SPEED_FACTOR", 1.0)), time.monotonic()
    companion = Endpoint(14580 + instance, instance + 1, (HOST, 14540 + instance))
    station = Endpoint(18570 + instance, instance + 1, None)
    streams: set[int] = set()
    next_heartbeat = 0.0
    station.send(mavlink.MAVLink_gps_global_origin_message(*ORIGIN))  # once, and nobody listens yet
    while True:
        now = speed * (time.monotonic() - start)
        for endpoint in (companion, station):
            for message in endpoint.receive():
                answer(endpoint, message, streams)
            if now >= next_heartbeat:
                endpoint.send(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 1, 4 << 16, 3, 3))
        next_heartbeat += now >= next_heartbeat
        none = [float("nan")] * 21
        attitude = [1.0, 0.0, 0.0, 0.0]
        companion.send(
            mavlink.MAVLink_odometry_message(int(1e6 * now), 1, 1, 0, 0, 0, attitude, *[0.0] * 6, none, none, 0, 0)
        )
        if mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION in streams and not is_lame:
            latitude, longitude, altitude = ORIGIN
            station.send(
                mavlink.MAVLink_hil_state_quaternion_message(
                    0, attitude, 0, 0, 0, latitude, longitude, altitude + 500, 0, 0, 0, 0, 0, 0, 0, 0
                )
            )
            station.send(mavlink.MAVLink_system_time_message(0, int(1e3 * now)))
        time.sleep(0.02)


if __name__ == "__main__":
    main(int(sys.argv[sys.argv.index("-i") + 1]))
