"""A stream as a source of the session: the newest sweeps and state at every tick, planned in open loop."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aero_planner import Goal, Sweeps, VehicleState
from aero_planner.quaternions import rotate
from aero_viz.errors import UserError
from aero_viz.live.assembly import Assembler
from aero_viz.live.setup import Setup
from aero_viz.live.stream import LiveMessage, Stream
from aero_viz.planners.observation import Observation
from aero_viz.planners.plan import Plan
from aero_viz.recordings.pose_messages import decode_poses
from aero_viz.recordings.ros_messages import DamagedMessage, decode_message
from aero_viz.recordings.source import checked_goal
from aero_viz.session.source import SourceInfo

GOAL_TYPES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped", "nav_msgs/msg/Odometry")
"""Types of the topics that a goal may come from."""

_OPEN_LOOP = "Live, in open loop: the plan is computed from what arrives now, and is not flown."
_QUEUE = 4096
"""Messages that may wait for a tick."""


@dataclass(frozen=True, eq=False)
class Tick:
    """Inputs at one tick; with it, the tick is planned again."""

    time: float
    """Source time [s]."""
    arrival: int
    """When it was taken [ns], by the clock of the stream."""
    state: VehicleState
    goal: NDArray[np.float64]
    """[m], shape [3], world frame."""
    sweeps: Sweeps
    cloud_age: float
    """[s]."""
    stamp: int
    """Stamp of the newest sweep as it was published [ns]."""
    trouble: str | None
    """What was wrong with the stream, as sentences; None if nothing was."""


class StreamSource:
    """Plans from a stream at a fixed rate; see `aero_viz.session.source.Source`.

    An earlier tick is returned to with its checkpoint; `advance` always goes to the newest messages.

    Args:
        stream: the messages; closed by whoever feeds it.
        setup: how to read them, see `find_setup`.
        rate: ticks per second.
        goal: first goal [m], shape [3], world frame; None is a place ahead of the drone.
        goal_topic: topic whose positions are the goal, if there are any.
        goal_ahead: distance of a goal ahead of the drone [m].
        kept: time for which ticks can be returned to [s].

    Raises:
        UserError: there is no sweep with a pose yet.
    """

    outcome: str | None = None
    """Always None: a stream that is silent may go on."""

    def __init__(
        self,
        stream: Stream,
        setup: Setup,
        *,
        rate: float = 20.0,
        goal: ArrayLike | None = None,
        goal_topic: str | None = None,
        goal_ahead: float = 15.0,
        kept: float = 180.0,
    ) -> None:
        self.stream, self.setup = stream, setup
        self.goal_topic, self._goal_ahead = goal_topic, goal_ahead
        self._goal: NDArray[np.float64] | None = None if goal is None else checked_goal(goal)
        self._assembler = Assembler(stream, setup)
        self._queue: deque[LiveMessage] = deque(maxlen=_QUEUE)
        self._end = stream.listen(self._queue.append, from_kept=True)
        self._newest = -np.inf
        self._origin: float | None = None
        self._drain(pace=True)
        if not self._assembler.has_inputs:
            self._end()
            raise UserError(f"{stream.name} has no sweep with a pose yet: wait for both, and try again.")
        self._tick = self.newest = self._take()
        """The newest tick, whichever is the present one."""
        self.info = SourceInfo(
            name=stream.name,
            closed_loop=False,
            period=1.0 / rate,
            start=np.asarray(self._tick.state.position, np.float64),
            notices=(_OPEN_LOOP,),
            kept=max(round(kept * rate), 1),
        )

    @property
    def tick(self) -> Tick:
        """The present tick."""
        return self._tick

    @property
    def explanation(self) -> str | None:
        """What is wrong with the stream at this tick, None if nothing is."""
        return self._tick.trouble

    def observe(self) -> Observation:
        """Return the planner's input at this tick."""
        tick = self._tick
        times = np.array([arrival.time for arrival in tick.sweeps.arrivals if arrival is not None])
        return Observation(
            tick.time, tick.state, Goal(tick.goal), tick.sweeps, cloud_age=tick.cloud_age, sweep_times=times
        )

    def advance(self, plan: Plan | None = None) -> None:
        """Go to the newest messages; the plan is ignored."""
        self._drain()
        self._tick = self.newest
        self._tick = self.newest = self._take()

    def checkpoint(self) -> Tick:
        """Return the inputs of this tick."""
        return self._tick

    def restore(self, checkpoint: object) -> None:
        """Return to an earlier tick until the next `advance`."""
        if not isinstance(checkpoint, Tick):
            raise TypeError(f"expected a checkpoint of a stream, got {type(checkpoint).__name__}")
        self._tick = checkpoint

    def seek(self, time: float) -> None:
        """Raise TypeError: a stream has no ticks but those that were taken."""
        raise TypeError("a stream is returned to by its checkpoints")

    def set_goal(self, position: ArrayLike | None) -> None:
        """Fix the goal at `position` [m], shape [3], world frame, from this tick on; None is ahead of the drone."""
        self._goal = None if position is None else checked_goal(position)
        self._tick = replace(self._tick, goal=self._goal_for(self._tick.state))

    def use(self, setup: Setup) -> None:
        """Read the messages of the same topics otherwise from now on."""
        self.setup = self._assembler.setup = setup

    def close(self) -> None:
        """Listen no longer."""
        self._end()

    def _drain(self, *, pace: bool = False) -> None:
        """Take the messages that wait; with `pace`, place each sweep when it arrived, as if it were now."""
        for _ in range(len(self._queue)):
            message = self._queue.popleft()
            if message.topic == self.goal_topic and message.type in GOAL_TYPES:
                self._take_goal(message)
            self._assembler.add(message)
            if pace:
                self._assembler.place(message.time)

    def _take(self) -> Tick:
        now = self.stream.clock.now()
        if not self._assembler.has_inputs:  # a clock was set a moment ago
            self._assembler.place(now)
        if not self._assembler.has_inputs:
            return replace(self._tick, time=self._after(self._tick.time), trouble=self._trouble(now))
        inputs = self._assembler.inputs(now)
        if self._origin is None or inputs.time + self._origin < self._newest - 1.0:
            # The first tick, or one behind a clock that was set: the time of the source goes on.
            self._origin = max(self._newest, 0.0) - inputs.time
        time = self._after(inputs.time + self._origin)
        goal, trouble = self._goal_for(inputs.state), self._trouble(now)
        return Tick(time, now, inputs.state, goal, inputs.sweeps, inputs.cloud_age, inputs.stamp, trouble)

    def _after(self, time: float) -> float:
        self._newest = max(time, self._newest + 1e-6)
        return self._newest

    def _trouble(self, now: int) -> str | None:
        found = [
            text
            for topic in self.setup.used
            if topic in self.stream.topics
            for text in self.stream.topics[topic].sentences(now)
        ]
        return " ".join(f"{text[0].upper()}{text[1:]}." for text in found) or None

    def _goal_for(self, state: VehicleState) -> NDArray[np.float64]:
        if self._goal is not None:
            return self._goal
        forward = rotate(np.asarray(state.quaternion), np.array([1.0, 0.0, 0.0]))
        heading = np.arctan2(forward[1], forward[0])
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        return np.asarray(state.position) + self._goal_ahead * ahead

    def _take_goal(self, message: LiveMessage) -> None:
        """Use the position in a message. RViz sends goals on the ground, z = 0: they are flown to at this height."""
        health = self.stream.topics[message.topic]
        try:
            if message.type == GOAL_TYPES[1]:
                point: Any = decode_message(message.data, message.type, "cdr").point
                goal = np.array([point.x, point.y, point.z])
            else:
                pose = decode_poses(message.data, message.type, "cdr")[0]
                goal = np.array(pose.values[:3])
            is_on_ground = message.type == GOAL_TYPES[0] and goal[2] == 0.0
            goal = checked_goal(goal - self.setup.offset)
        except DamagedMessage as error:
            return health.refuse(str(error))
        except UserError:
            return health.refuse("its position is not valid")
        if is_on_ground and self._newest > -np.inf:
            goal[2] = np.asarray(self._tick.state.position)[2]
        self._goal = goal
