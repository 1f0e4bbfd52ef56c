"""The companion computer of a simulated autopilot."""

import math
import socket
from typing import Any

from aero_planner.onboard.mavlink_sender import load_dialect
from aero_viz.flight.vehicle_model import VehicleModel
from aero_viz.rig.autopilot import PERIOD, SimulatedAutopilot

mavlink = load_dialect()
HALF = math.sqrt(0.5)
START = (1.0, 2.0, 3.0)
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Companion:
    """The companion computer at the other end of the connection, in simulated time."""

    def __init__(self, **options: Any) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.protocol = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        options = {"heading": 0.0, "model": VehicleModel(step=PERIOD)} | options
        self.autopilot = SimulatedAutopilot(start=START, address=self.socket.getsockname(), **options)
        self.tick = 0
        self.messages = []

    @property
    def now(self):
        return self.tick * PERIOD

    def send(self, message):
        target = ("127.0.0.1", self.autopilot.port)
        self.socket.sendto(bytes(message.pack(self.protocol)), target)

    def command(self, thrust=0.5, rates=(0.0, 0.0, 0.0), *, mask=128, component=1, attitude=LEVEL):
        self.send(mavlink.MAVLink_set_attitude_target_message(0, 1, component, mask, attitude, *rates, thrust))

    def run(self, seconds, *, every=0.02, **command):
        """Step for some seconds, with a command every `every` seconds, or without commands if it is None."""
        for _ in range(round(seconds / PERIOD)):
            if every is not None and self.tick % round(every / PERIOD) == 0:
                self.command(**command)
            self.tick += 1
            self.autopilot.step(self.tick - 1, self.now)
            while True:
                try:
                    data = self.socket.recv(2048)
                except BlockingIOError:
                    break
                self.messages += [(self.now, message) for message in mavlink.MAVLink(None).parse_buffer(data)]

    def got(self, name):
        return [(time, message) for time, message in self.messages if message.get_type() == name]

    def fly(self, seconds=0.0, **command):
        """Get control of the vehicle by the rules, then send commands for some seconds."""
        self.run(1.1)
        self.autopilot.arm()
        assert self.autopilot.engage()
        self.run(seconds, **command)
