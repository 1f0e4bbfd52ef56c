"""A planner in a process of its own, for AERO-Viz: one file, standard library only, Python 3.8 or newer.

    import aero_viz_planner

    def plan(request):
        ...  # request.position, request.points, request.config["reach"], ..
        return {"positions": [[[x, y, z], ..], ..], "costs": {"goal": [..]}, "best": 0, "step": 0.1}

    reach = {"name": "reach", "default": 6.0, "low": 1.0, "high": 20.0, "unit": "m", "help": "How far it looks."}
    aero_viz_planner.serve("/tmp/mine.sock", plan, parameters=[reach])

Then `aero-viz demo --planner connect:/tmp/mine.sock`. The messages are described in docs/planners.md.
"""

import array
import json
import os
import socket
import struct
import sys
import threading
import traceback

VERSION = 1
_HEAD = struct.Struct("<II")  # bytes of the JSON text, and of the numbers that follow it


class Request:
    """What AERO-Viz knows at one tick: SI units, world frame (x forward, y left, z up).

    Attributes:
        time, cloud_age, ground_height: [s], [s] and [m]; the last one is None where it is unknown.
        position, velocity, quaternion, acceleration: of the drone; w x y z, body to world; acceleration may be None.
        goal: position of the goal.
        points: the cloud as an array of float32, x y z of one point after another; it may hold NaN.
        config: value of each parameter by its name, and the drone's by names such as "vehicle.speed_limit".
        history: what the previous reply gave as "history"; None at the start, and after a jump in time an older one.
    """

    def __init__(self, header, points):
        self.__dict__.update(header)
        self.points = points


def serve(address, plan, parameters=(), name="planner"):
    """Answer requests for ever, each connection on a thread of its own.

    Args:
        address: path of a Unix socket, which is replaced, or "HOST:PORT".
        plan: called with a `Request`; returns the reply as a dict, see docs/planners.md.
        parameters: one dict per parameter: name, default, low, high, and optionally unit and help.
        name: name for people.
    """
    host, colon, port = address.rpartition(":")
    if colon and port.isdigit():
        listener = socket.create_server((host, int(port)))
    else:
        if os.path.exists(address):
            os.unlink(address)
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(address)
        listener.listen()
    print(f"planner {name} listens at {address}", file=sys.stderr, flush=True)
    hello = {"type": "hello", "version": VERSION, "name": name, "parameters": list(parameters)}
    while True:
        connection, _ = listener.accept()
        threading.Thread(target=_answer, args=(connection, plan, hello), daemon=True).start()


def _answer(connection, plan, hello):
    with connection:
        while True:
            message = receive(connection)
            if message is None:
                return
            header, numbers = message
            if header["type"] == "hello":
                send(connection, hello)
                continue
            try:
                reply = dict(plan(Request(header, numbers)))
                paths = reply.pop("positions")
                flat = array.array("f", [float(x) for path in paths for place in path for x in place])
                send(connection, {"type": "plan", **reply, "shape": [len(paths), len(paths[0]), 3]}, flat)
            except Exception as error:  # it ends the flight; the next one may go well
                traceback.print_exc()
                send(connection, {"type": "error", "text": f"{type(error).__name__}: {error}"})


def send(connection, header, numbers=None):
    """Send a message: a JSON object, and float32 numbers."""
    text, body = json.dumps(header).encode(), b"" if numbers is None else numbers.tobytes()
    connection.sendall(_HEAD.pack(len(text), len(body)) + text + body)


def receive(connection):
    """Return the next message, a dict and an array of float32; None at the end of the connection."""
    head = _read(connection, _HEAD.size)
    if head is None:
        return None
    text_size, body_size = _HEAD.unpack(head)
    text, body = _read(connection, text_size), _read(connection, body_size)
    if text is None or body is None:
        return None
    numbers = array.array("f")
    numbers.frombytes(body)
    return json.loads(text), numbers


def _read(connection, size):
    data = bytearray()
    while len(data) < size:
        part = connection.recv(min(size - len(data), 1 << 20))
        if not part:
            return None
        data += part
    return bytes(data)
