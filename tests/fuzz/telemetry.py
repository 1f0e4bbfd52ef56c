"""Messages of a hostile node to `aero-viz connect`, and their expected results."""

import json
import math
import socket
import struct
import threading
import zlib
from contextlib import closing, suppress
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from fuzz.mutation import mutate

_VALUES = (None, -1, 0, 2**70, 1e308, math.nan, math.inf, "", "x" * 9000, [], [[]], {}, True, {"a": 1}, ["\n\x1b[2J"])
_HEADER = struct.Struct("<4sHHIII")


@cache
def _messages() -> tuple[bytes, ...]:
    """Return the greeting, a transition, a plan of a real planner, and a status of its parameters."""
    from aero_planner import Goal, Planner, PlannerConfig, Sweeps, VehicleState
    from aero_planner.onboard.failsafe_table import State
    from aero_planner.onboard.interfaces import PlanRecord
    from aero_planner.onboard.settings import OnboardConfig
    from aero_planner.onboard.telemetry import encode_plan
    from aero_planner.onboard.telemetry_protocol import Kind, encode
    from aero_planner.onboard.tuning import Tuning

    config = PlannerConfig().replace({"sampling.samples": 16})
    state, goal = VehicleState(np.array([0.0, 0.0, 2.0]), np.zeros(3), np.array([1.0, 0, 0, 0])), np.array([9.0, 0, 2])
    sweeps = Sweeps([np.random.default_rng(0).uniform(-9, 9, (200, 3)).astype(np.float32)])
    with closing(Planner(config)) as planner:
        plan = planner.plan(state, Goal(goal), sweeps)
        record = PlanRecord(1, 5.0, state, state, goal, sweeps, 0.1, plan, 9.0, State.FLYING)
        data = encode_plan(record, points_max=200)
    hello = encode(Kind.HELLO, {"planner": config.to_dict(), "onboard": OnboardConfig().to_dict()})
    change = encode(Kind.CHANGE, {"time": 1.0, "source": "READY", "target": "FLYING", "cause": "engaged"})
    tuning = Tuning(config, OnboardConfig().replace({"tuning.limits": "vehicle.speed_limit 1..7"}), b"")
    return hello, change, data, encode(Kind.STATUS, {**tuning.status(None), "denied": ""})


def generate(random: np.random.Generator) -> bytes:
    """Return a stream of telemetry with damage to the bytes or, with valid lengths and checksums, to the content."""
    parts = list(_messages()) + [_messages()[2]] * int(random.integers(3))
    at = int(random.integers(len(parts)))
    if random.uniform() < 0.3:
        return b"".join(parts[:at]) + mutate(parts[at], random) + b"".join(parts[at + 1 :])
    *_, kind, _, _, _ = _HEADER.unpack_from(parts[at])
    content = zlib.decompress(parts[at][_HEADER.size :])
    (length,) = struct.unpack_from("<I", content)
    text, arrays = content[4 : 4 + length], content[4 + length :]
    if random.uniform() < 0.7:
        text = json.dumps(_altered(json.loads(text), random)).encode()
    if random.uniform() < 0.3:
        text = mutate(text, random)
    if random.uniform() < 0.3:
        arrays = mutate(arrays, random)
    content = struct.pack("<I", len(text)) + text + arrays
    packed = zlib.compress(content)
    parts[at] = _HEADER.pack(b"AERO", 1, kind, len(packed), len(content), zlib.crc32(packed)) + packed
    return b"".join(parts)


def _altered(message: Any, random: np.random.Generator) -> Any:
    """Return a message with another value, or without one, at a random place."""
    place: Any = message
    while True:
        parent = place
        keys = list(parent) if isinstance(parent, dict) else range(len(parent))
        key = keys[random.integers(len(keys))]
        place = parent[key]
        if not isinstance(place, dict | list) or not place or random.uniform() < 0.2:
            break
    if random.uniform() < 0.2:
        del parent[key]
    else:
        parent[key] = _VALUES[random.integers(len(_VALUES))]
    return message


def read(path: Path) -> None:
    """Connect to a node that sends the content of a file; every frame has to be one that the page can draw."""
    from aero_viz.session.frame import Frame
    from aero_viz.session.node_client import NodeClient

    def respond() -> None:
        with suppress(OSError):
            connection, _ = server.accept()
            with connection:
                connection.sendall(path.read_bytes())

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=respond, daemon=True).start()
        with closing(NodeClient("127.0.0.1", server.getsockname()[1])) as client:
            for frame in islice(client, 20):
                if isinstance(frame, Frame):
                    assert np.isfinite(np.asarray(frame.observation.state.position, dtype=float)).all()
