"""The simulator as a node of ROS 2: a planner of the workbench that asks whoever commands the drone there.

It publishes what the drone sees, in real time, and flies what it is told. To the workbench it is a planner like any
other, so that flights are judged, shown, logged and counted as all others are.
"""

from __future__ import annotations

import atexit
import logging
import threading
import time
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from aero_planner import PlanStatus, Sweeps
from aero_planner.config import DroneConfig, VehicleConfig
from aero_planner.onboard.ros_messages import BODY, cloud, goal_message, pose_messages, wall_time
from aero_planner.quaternions import rotation_matrix
from aero_viz.errors import UserError
from aero_viz.logs.flight_messages import new_sweeps
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import CandidatePlan
from aero_viz.planners.planner import Planner, PlannerError
from aero_viz.ros.commands import READERS, TOPICS, Following, Setpoint, Situation, Velocity
from aero_viz.ros.graph import Graph

_STEP, _STEPS = 0.1, 15
"""Time step [s] and number of steps of the path that is expected."""
_RETRY = 0.2
"""Period with which the first observation is published again until somebody commands the drone [s]."""
_BRAKE = Velocity(np.zeros(3), kind="brake")
_JUMP = 20_000_000  # [ns] between the stamps before and after a jump back in time
_KINDS = ", ".join(READERS)
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class RosConfig(DroneConfig):
    """The drone and how it follows commands."""

    planner: ClassVar[str] = "ros"

    vehicle: VehicleConfig = field(default_factory=lambda: VehicleConfig(model="acceleration"))
    ros: Following = field(default_factory=Following)


@dataclass(frozen=True)
class _Command:
    topic: str
    setpoint: Setpoint
    time: float
    """Simulated time at which it arrived [s]."""


class RosPlanner(Planner):
    """Publishes /clock, /odometry, /tf, /points and /goal_pose, and flies the commands of `commands.TOPICS`.

    Every plan takes as long as the time since the one before it, so that flights run in real time. The first one
    hovers, the second one waits for a command. When commands stop, the drone brakes. Stamps are the wall time at the
    beginning plus the simulated time, and never go back.
    """

    Config = RosConfig

    def __init__(self, config: DroneConfig | None = None, *, device: str = "cpu", seed: int = 0) -> None:
        super().__init__(config, device=device, seed=seed)
        self._graph: Graph | None = None
        self._publishers: dict[str, Any] = {}
        self._subscribed: set[str] = set()
        self._refused: set[str] = set()
        self._arrived = threading.Event()
        """Set by every command."""
        self._interrupted = threading.Event()
        self._base = self._stamp = round(1e9 * wall_time())
        """Stamps of the simulated time 0, and of the last observation [ns]."""
        self.reset()

    def reset(self, *, seed: int | None = None) -> None:
        super().reset(seed=seed)
        self._situation: Situation | None = None
        self._command: _Command | None = None
        self._arrived.clear()
        self._due: float | None = None
        """Wall time at which the next observation may be published [s], `time.monotonic`."""
        self._sweeps: Sweeps | None = None
        self._goal: Any = None

    def plan(self, observation: Observation) -> CandidatePlan:
        """Publish the observation when it is due, and return what the newest command makes of the drone.

        Raises:
            PlannerError: no command has arrived for too long.
        """
        before = self._situation
        graph = self._join()
        if before is None or observation.time != before.time:  # otherwise the tick is planned again
            self._wait_until_due(0.0 if before is None else observation.time - before.time)
        started = time.perf_counter()
        if before is not None and observation.time < before.time:
            self._base += self._stamp + _JUMP - self._stamp_of(observation.time)
            self._command, self._sweeps, self._goal = None, None, None
        self._situation = now = Situation(observation.time, observation.state, self.config.ros, self.config.vehicle)
        self._publish(graph, observation)
        if before is not None and observation.time > before.time and not self._arrived.is_set():
            self._wait_for_command(graph, observation)
            started = time.perf_counter()
        command = self._command
        is_heard = command is not None and now.time - command.time <= self.config.ros.timeout
        setpoint = command.setpoint if command is not None and is_heard else _BRAKE
        model, control = setpoint.control(now)
        path = setpoint.path(now, np.linspace(0.0, _STEP * _STEPS, _STEPS + 1))
        return CandidatePlan(
            path[None],
            {"goal": np.linalg.norm(path[-1:] - np.asarray(observation.goal.position), axis=1)},
            0,
            _STEP,
            status=PlanStatus.OK if is_heard else PlanStatus.NO_SAFE_CANDIDATE,
            controls=control[None],
            model=model,
            kinds=(setpoint.kind,),
            stage_ms={"total": 1e3 * (time.perf_counter() - started)},
        )

    def _join(self) -> Graph:
        if self._graph is None:
            self._graph = Graph("aero_viz_sim")
            atexit.register(self.close)  # a graph that outlives the interpreter aborts the process
            for topic, kind in (("/clock", "rosgraph_msgs/msg/Clock"), ("/points", "sensor_msgs/msg/PointCloud2"),
                                ("/odometry", "nav_msgs/msg/Odometry"), ("/goal_pose", "geometry_msgs/msg/PoseStamped"),
                                ("/tf", "tf2_msgs/msg/TFMessage")):  # fmt: skip
                try:
                    self._publishers[topic] = self._graph.publisher(topic, kind, latched=topic == "/goal_pose")
                except UserError:
                    _log.info("%s is not published: %s is not installed", topic, kind)
        return self._graph

    def _wait_until_due(self, period: float) -> None:
        """Wait until `period` [s] after the last observation; a flight that is late does not catch up."""
        now = time.monotonic()
        self._due = now if self._due is None else max(self._due + max(period, 0.0), now)
        time.sleep(self._due - now)

    def _wait_for_command(self, graph: Graph, observation: Observation) -> None:
        deadline = time.monotonic() + self.config.ros.patience
        self._listen(graph)
        while not self._arrived.wait(_RETRY):
            if self._interrupted.is_set():
                raise PlannerError("No command had arrived.")
            if time.monotonic() > deadline:
                raise PlannerError(
                    f"No command has arrived for {self.config.ros.patience:g} s on {', '.join(sorted(self._names()))}. "
                    "Start your planner in the same ROS_DOMAIN_ID, and see ros.topic and ros.patience."
                )
            self._listen(graph)  # the topic may have appeared
            self._sweeps = self._goal = None
            self._publish(graph, observation)
        self._due = time.monotonic()

    def _names(self) -> dict[str, str | None]:
        """Return the topics to obey with their types; None for a type that nobody has told yet."""
        topic = self.config.ros.topic
        return dict(TOPICS) if topic == "auto" else {topic: TOPICS.get(topic)}

    def _listen(self, graph: Graph) -> None:
        """Subscribe to the topics of commands whose types are known and installed, once."""
        for topic, known in self._names().items():
            if topic in self._subscribed:
                continue
            kind = known or next((found.types[0] for found in graph.topics() if found.name == topic), None)
            if kind is None:
                continue
            if kind not in READERS:
                raise PlannerError(f"{topic} has {kind}, which commands no drone; give ros.topic one of {_KINDS}.")
            try:
                graph.subscribe(topic, kind, lambda message, topic=topic, kind=kind: self._take(topic, kind, message))
            except UserError as error:
                _log.info("%s", error)
            self._subscribed.add(topic)

    def _take(self, topic: str, kind: str, message: Any) -> None:
        """Take a command, on the thread of the node."""
        situation, obeyed = self._situation, self._command
        if situation is None or topic not in self._names():
            return
        is_silent = obeyed is None or situation.time - obeyed.time > self.config.ros.timeout
        if obeyed is not None and topic != obeyed.topic and not is_silent:
            return
        try:
            setpoint = READERS[kind](message, situation, self._time_of)
        except (ValueError, IndexError) as error:
            if topic not in self._refused:
                self._refused.add(topic)
                _log.warning("A command on %s is ignored: %s.", topic, error)
            return
        self._command = _Command(topic, setpoint, situation.time)
        self._arrived.set()

    def _time_of(self, stamp: Any) -> float | None:
        return 1e-9 * (stamp.sec * 10**9 + stamp.nanosec - self._base) if stamp.sec or stamp.nanosec else None

    def _stamp_of(self, time: float) -> int:
        return self._base + round(1e9 * time)

    def _publish(self, graph: Graph, observation: Observation) -> None:
        from rosgraph_msgs.msg import Clock

        self._listen(graph)
        self._stamp = stamp = self._stamp_of(observation.time)
        clock = Clock()
        clock.clock.sec, clock.clock.nanosec = divmod(stamp, 10**9)
        self._send("/clock", clock)
        for message in pose_messages(observation.state, stamp):
            self._send(message.topic, message.data)
        if not np.array_equal(self._goal, observation.goal.position):
            self._goal = np.array(observation.goal.position)
            self._send("/goal_pose", goal_message(observation.goal, stamp).data)
        if (sweeps := observation.sweeps) is not self._sweeps:
            points = np.concatenate([*new_sweeps(self._sweeps, sweeps), np.zeros((0, 3), np.float32)])
            self._sweeps = sweeps
            seen = points[np.isfinite(points).all(axis=1)] - np.asarray(observation.state.position)
            if len(points):  # a sweep that shows nothing is one, too
                in_body = seen @ rotation_matrix(observation.state.quaternion)
                self._send("/points", cloud("/points", BODY, in_body, stamp).data)

    def _send(self, topic: str, message: Any) -> None:
        if (publisher := self._publishers.get(topic)) is not None:
            publisher.publish(message)

    def interrupt(self) -> None:
        self._interrupted.set()

    def close(self) -> None:
        if self._graph is not None:
            atexit.unregister(self.close)
            self._graph.close()
            self._graph = None
