"""Planners in other processes, in any language: messages over a local socket. docs/planners.md describes them."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import keyword
import math
import socket
import struct
import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlanStatus
from aero_planner.config import DroneConfig, ParameterSection
from aero_planner.parameters import live
from aero_viz.errors import UserError
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import CandidatePlan
from aero_viz.planners.planner import Planner, PlannerError

PREFIX = "connect:"
"""Beginning of the name of a planner in another process; its address follows."""
VERSION = 1
_HEAD = struct.Struct("<II")
"""Bytes of the JSON text of a message, and of the float32 numbers after it."""
_TEXT_MAX, _BODY_MAX = 1 << 22, 1 << 26
_CONNECT_TIMEOUT = 5.0
"""Longest wait for a connection, and for the answer to hello [s]."""
_PARAMETERS_MAX = 200


@functools.cache
def planner_at(address: str) -> type[Planner]:
    """Return the planner at an address, with the parameters that it names.

    Args:
        address: path of a Unix socket, or HOST:PORT on this computer.

    Raises:
        UserError: nothing answers there, or not as a planner.
    """
    try:
        with contextlib.closing(_Connection(address)) as connection:
            hello, _ = connection.ask({"type": "hello", "version": VERSION}, timeout=_CONNECT_TIMEOUT)
            return _planner_type(address, hello)
    except (PlannerError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"No planner can be used at {address}: {error}") from error


def _planner_type(address: str, hello: dict[str, Any]) -> type[Planner]:
    if hello.get("type") != "hello" or hello.get("version") != VERSION:
        raise ValueError(f"it answers {str(hello)[:80]!r}, not hello of version {VERSION}.")
    described = hello.get("parameters", [])
    if len(described) > _PARAMETERS_MAX:
        raise ValueError(f"it has {len(described)} parameters; {_PARAMETERS_MAX} are the most.")
    fields = [(str(one["name"]), float, _parameter(one)) for one in described]
    if wrong := [name for name, *_ in fields if not _is_usable(name)]:
        raise ValueError(f"{wrong[0]!r} is not a name for a parameter.")
    section = _section(fields)
    config: Any = dataclasses.make_dataclass(
        "RemoteConfig",
        [("planner", ClassVar[str], PREFIX + address), ("remote", section, dataclasses.field(default_factory=section))],
        bases=(DroneConfig,),
        frozen=True,
    )
    return type("RemotePlanner", (_RemotePlanner,), {"Config": config, "address": address})


def _section(fields: list[tuple[str, Any, Any]]) -> Any:
    class Parameters(ParameterSection, section="remote"):
        """Remote: parameters of the planner in the other process."""

        __annotations__ = {name: kind for name, kind, _ in fields}

    for name, _, value in fields:
        setattr(Parameters, name, value)
    return dataclasses.dataclass(frozen=True)(Parameters)


def _is_usable(name: str) -> bool:
    is_taken = name.startswith("_") or keyword.iskeyword(name) or hasattr(ParameterSection, name)
    return name.isidentifier() and not is_taken


def _parameter(one: dict[str, Any]) -> Any:
    default, low, high = (float(one[key]) for key in ("default", "low", "high"))
    if not low <= default <= high or not math.isfinite(high - low):
        raise ValueError(f"the parameter {one['name']!r} is {default:g} in [{low:g}, {high:g}].")
    return live(default, str(one.get("unit", "")), low, high, str(one.get("help", "A parameter.")), basic=True)


@dataclasses.dataclass(frozen=True)
class _History:
    """What the other process wants to be given with its next question."""

    address: str
    value: Any


class _RemotePlanner(Planner):
    """A planner in another process. It holds no state: the other process gets back the history that it has sent."""

    address: ClassVar[str]
    timeout: ClassVar[float] = 5.0
    """Longest wait for a plan [s]. A process that takes longer counts as hung."""

    def __init__(self, config: DroneConfig | None = None, *, device: str = "cpu", seed: int = 0) -> None:
        super().__init__(config, device=device, seed=seed)
        self._connection: _Connection | None = None
        self._history: Any = None

    def history(self) -> _History:
        return _History(self.address, self._history)

    def restore(self, history: Any) -> None:
        is_own = isinstance(history, _History) and history.address == self.address
        self._history = history.value if is_own else None

    def reset(self, *, seed: int | None = None) -> None:
        super().reset(seed=seed)
        self._history = None

    def plan(self, observation: Observation) -> CandidatePlan:
        started = time.perf_counter()
        points, ground = observation.points, observation.ground_height
        request = {
            "type": "plan", "time": observation.time, "seed": self.seed, "history": self._history,
            "cloud_age": observation.cloud_age, "ground_height": _numbers(ground), "config": self._values(),
            "goal": _numbers(observation.goal.position), "points": len(points),
            **{name: _numbers(getattr(observation.state, name))
               for name in ("position", "velocity", "quaternion", "acceleration")},
        }  # fmt: skip
        try:
            if self._connection is None:
                self._connection = _Connection(self.address)
            reply, body = self._connection.ask(request, points, timeout=self.timeout)
            plan = _plan(reply, body, 1e3 * (time.perf_counter() - started))
        except (PlannerError, KeyError, TypeError, ValueError, OverflowError) as error:
            self.close()  # the next plan begins with a new connection
            text = str(error) if isinstance(error, PlannerError) else f"it sent a plan that is none: {error!r}"
            raise PlannerError(f"The planner at {self.address} failed: {text}") from error
        self._history = reply.get("history")
        return plan

    def _values(self) -> dict[str, Any]:
        own = {info.name: self.config.get(info.path) for info in self.config.parameters() if info.section == "remote"}
        return own | {info.path: self.config.get(info.path) for info in self.config.sections()["vehicle"].parameters()}

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


class _Connection:
    """A connection that asks and waits for one answer.

    Raises:
        PlannerError: nothing listens at the address.
    """

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        try:
            if port.isdigit() and host:
                if host not in ("localhost", "127.0.0.1", "::1"):
                    raise PlannerError(f"{host} is not this computer; planners are asked on localhost only.")
                self._socket = socket.create_connection((host, int(port)), timeout=_CONNECT_TIMEOUT)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            else:
                self._socket = socket.socket(socket.AF_UNIX)
                self._socket.settimeout(_CONNECT_TIMEOUT)
                self._socket.connect(address)
        except OSError as error:
            raise PlannerError(f"nothing listens there ({error.strerror or error}).") from error

    def ask(
        self, header: dict[str, Any], points: NDArray[np.float32] | None = None, *, timeout: float
    ) -> tuple[dict[str, Any], NDArray[np.float32]]:
        """Send a message and return the answer.

        Raises:
            PlannerError: the connection ended, the answer took too long, is too large or no message.
        """
        text = json.dumps(header).encode()
        body = b"" if points is None else np.ascontiguousarray(points, dtype="<f4").tobytes()
        deadline = time.monotonic() + timeout
        try:
            self._socket.settimeout(timeout)
            self._socket.sendall(_HEAD.pack(len(text), len(body)) + text + body)
            text_size, body_size = _HEAD.unpack(self._read(_HEAD.size, deadline))
            if text_size > _TEXT_MAX or body_size > _BODY_MAX or body_size % 4:
                raise PlannerError(f"it sent {text_size} and {body_size} bytes, which is no message.")
            answer = json.loads(self._read(text_size, deadline), parse_constant=_refuse)
            numbers = np.frombuffer(self._read(body_size, deadline), dtype="<f4")
        except TimeoutError:
            raise PlannerError(f"it did not answer within {timeout:g} s.") from None
        except OSError as error:
            raise PlannerError(f"the connection is lost ({error.strerror or error}).") from error
        except (UnicodeDecodeError, ValueError, RecursionError) as error:
            raise PlannerError(f"it sent something else than a message: {error}") from error
        if not isinstance(answer, dict):
            raise PlannerError("it sent something else than a JSON object.")
        if answer.get("type") == "error":
            raise PlannerError(str(answer.get("text", "it gave no reason"))[:300])
        return answer, numbers

    def _read(self, size: int, deadline: float) -> bytes:
        data = bytearray()
        while len(data) < size:
            left = deadline - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            self._socket.settimeout(left)
            part = self._socket.recv(min(size - len(data), 1 << 20))
            if not part:
                raise PlannerError("it closed the connection; its own terminal may say why.")
            data += part
        return bytes(data)

    def close(self) -> None:
        """End the connection."""
        self._socket.close()


def _plan(reply: dict[str, Any], body: NDArray[np.float32], total_ms: float) -> CandidatePlan:
    """Return the plan in an answer; raises KeyError, TypeError or ValueError if it is none."""
    shape = tuple(int(size) for size in reply["shape"])
    if reply.get("type") != "plan" or len(shape) != 3 or math.prod(shape) != len(body):
        raise ValueError(f"it has {len(body)} numbers for paths of the shape {shape}")
    optional = {
        name: reply[name] for name in ("controls", "model", "clearance", "kinds") if reply.get(name) is not None
    }
    if reply.get("is_safe") is not None:
        optional["is_safe"] = np.array(reply["is_safe"], dtype=bool)
    plan = CandidatePlan(
        positions=body.reshape(shape),
        costs={str(name): np.asarray(cost, dtype=np.float32) for name, cost in dict(reply["costs"]).items()},
        best=int(reply["best"]),
        step=float(reply["step"]),
        status=PlanStatus(int(reply.get("status", 0))),
        stage_ms={"total": total_ms},
        **optional,
    )
    if plan.model not in ("acceleration", "ctbr"):
        raise ValueError(f"model is {plan.model!r}; it must be acceleration or ctbr")
    return plan


def _numbers(values: Any) -> Any:
    """Return numbers as JSON can hold them; None where they are unknown."""
    return None if values is None or not np.isfinite(values).all() else np.asarray(values, dtype=np.float64).tolist()


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant} is not a number of JSON")
