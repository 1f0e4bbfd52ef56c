"""Changes of parameters on the drone: what is allowed, when, and what the node does with them."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from aero_planner import Planner, PlannerConfig, VehicleState
from aero_planner.config.file import ConfigFile
from aero_planner.config.yaml_entries import parse_entries
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.flight_log import FlightLog
from aero_planner.onboard.interfaces import ConfigChange, Observation, Observer, VehicleSample
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.onboard.tuning import AGE_MAX, Request, Tuning
from aero_planner.onboard.tuning_limits import tunable_parameters
from tests.planner.onboard.simulated import CORRIDOR, GOAL, SMALL, Clock, Relay, Simulation, poles
from tests.planner.onboard.test_flight_log import decoded

KEY = bytes(range(32))
LIMITS = "vehicle.speed_limit 1..6, costs.q_track 1..30, candidates.prefer_safe"
ONBOARD = OnboardConfig().replace({"telemetry.port": 0, "tuning.limits": LIMITS})
FASTER = {"vehicle.speed_limit": 6.0}


def sample(*, armed: bool) -> VehicleSample:
    state = VehicleState(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), None, 1.0)
    return VehicleSample(1.0, state, armed, armed, 1.0)


class Asking:
    """A node's parameters, and somebody who asks for changes and sees what the planner gets."""

    def __init__(self, clock: Clock, onboard: OnboardConfig = ONBOARD) -> None:
        self.tuning = Tuning(SMALL, onboard, KEY, clock=clock)
        self.tuning.observe(sample(armed=False))
        self.configured: list[PlannerConfig] = []
        self._numbers = itertools.count(1)

    def submit(self, changes: Any = None, **content: Any) -> Request:
        status = self.tuning.status(None)
        content = {"time": status["time"], "version": status["version"], "changes": changes} | content
        request = Request(next(self._numbers), "tester", content)
        self.tuning.submit(request)
        return request

    def take(self) -> ConfigChange | None:
        return self.tuning.take(self.configured.append)

    def ask(self, changes: Any = None, **content: Any) -> str:
        """Return the answer after the next plan: empty, or why nothing has changed."""
        request, before = self.submit(changes, **content), (self.tuning.config, self.tuning.version)
        self.take()
        assert request.answer is not None
        assert not request.answer or (self.tuning.config, self.tuning.version) == before
        return request.answer


@pytest.fixture
def asking(clock: Clock) -> Asking:
    return Asking(clock)


# --- what is allowed ---


@pytest.mark.parametrize(
    ("limits", "problem"),
    [
        ("vehicle.speed_limt 1..2", "did you mean 'vehicle.speed_limit'"),
        ("sampling.samples 1..2", "sampling.samples is structural"),
        ("vehicle.mass 0.5..2", "the node itself relies on vehicle.mass"),
        ("costs.use_ground", "the node itself relies on costs.use_ground"),
        ("vehicle.speed_limit", "vehicle.speed_limit needs bounds; write vehicle.speed_limit "),
        ("candidates.prefer_safe 0..1", "candidates.prefer_safe has no bounds; write candidates.prefer_safe"),
        ("vehicle.speed_limit 3..2", "has the bounds 3..2; they must rise"),
        ("vehicle.speed_limit 1..1e9", "must rise, within"),
        ("costs.q_track 1..5, vehicle.speed_limit 1..3", "it must include the value with which the node starts"),
    ],
)
def test_limits_that_make_no_sense_are_refused(limits: str, problem: str):
    with pytest.raises(ValueError, match=problem):
        check_together(SMALL, OnboardConfig().replace({"tuning.limits": limits}))


@pytest.mark.parametrize(
    "limits", ["", "speed_limit 1..2", "vehicle.speed_limit 1...2", "a.b 1..2 c.d 1..2", "a.b 1.."]
)
def test_malformed_limits_are_refused(limits: str):
    with pytest.raises(ValueError, match="none, or a list such as"):
        OnboardConfig().replace({"tuning.limits": limits})


def test_limits_hold_the_bounds_of_each_parameter():
    tunable = tunable_parameters(LIMITS)
    assert list(tunable) == ["vehicle.speed_limit", "costs.q_track", "candidates.prefer_safe"]
    assert (tunable["vehicle.speed_limit"].low, tunable["vehicle.speed_limit"].high) == (1.0, 6.0)
    assert tunable_parameters("none") == {}


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"vehicle.speed_limit": 6.1}, "vehicle.speed_limit is 6.1; it must be a number in [1, 6]"),
        ({"vehicle.speed_limit": math.nan}, "vehicle.speed_limit is nan"),
        ({"vehicle.speed_limit": "5"}, "vehicle.speed_limit is '5'"),
        ({"vehicle.speed_limit": [5]}, "vehicle.speed_limit is [5]"),
        ({"candidates.prefer_safe": 1}, "it must be true or false"),
        ({"costs.q_vnorm": 1.0}, "'costs.q_vnorm' can't be changed: tuning.limits of the node allows"),
        ({"vehicle.speed_limit": 6.0, "sampling.samples": 8}, "'sampling.samples' can't be changed"),
        ({"vehicle.speed_limit": 5.0}, "nothing would change"),
        ({}, "malformed"), (None, "malformed"), ([], "malformed"), ("x", "malformed"),
    ],
)  # fmt: skip
def test_changes_beyond_the_limits_are_refused(asking: Asking, changes: Any, problem: str):
    assert problem in asking.ask(changes)
    assert asking.configured == [] and asking.tuning.config == SMALL


def test_without_limits_nothing_can_be_changed(clock: Clock):
    asking = Asking(clock, OnboardConfig())
    assert "tuning.limits of the node allows nothing" in asking.ask(FASTER)


# --- when ---


def test_a_change_is_taken_with_the_next_plan_and_not_before(asking: Asking):
    request = asking.submit(FASTER)
    assert request.answer is None and asking.tuning.version == 0 and asking.tuning.status(request)["waits"] is True
    change = asking.take()
    assert change is not None and change.version == asking.tuning.version == 1
    assert asking.configured == [change.config] == [SMALL.replace(FASTER)]
    status = asking.tuning.status(request)
    assert (status["waits"], status["refused"], status["version"]) == (False, "", 1)
    assert status["values"]["vehicle.speed_limit"] == 6.0
    assert asking.take() is None


def test_an_armed_drone_takes_only_confirmed_changes(asking: Asking):
    for armed in (True, None):  # None: the node has not heard from the drone yet
        if armed is None:
            asking.tuning = Tuning(SMALL, ONBOARD, KEY, clock=Clock())
        else:
            asking.tuning.observe(sample(armed=armed))
        assert "armed, and the change was not confirmed" in asking.ask(FASTER)
        assert "not confirmed" in asking.ask(FASTER, confirmed="yes")
        assert asking.ask(FASTER, confirmed=True) == ""
        assert asking.ask(step="undo") == "", "one click is enough to go back"


def test_a_change_that_waits_while_the_drone_is_armed_needs_the_confirmation(asking: Asking):
    request = asking.submit(FASTER)
    asking.tuning.observe(sample(armed=True))
    assert asking.take() is None and "armed" in str(request.answer)


@pytest.mark.parametrize("state", [State.BRAKING, State.WITHDRAWING])
def test_nothing_changes_while_the_drone_brakes(asking: Asking, state: State):
    waiting = asking.submit(FASTER)
    asking.tuning.observe(StateChange(1.0, State.FLYING, state, Cause.CLOUD_STALE))
    assert asking.take() is None
    for answer in (str(waiting.answer), asking.ask(FASTER), asking.ask(step="takeoff"), asking.ask(step="undo")):
        assert "the drone is braking: no points from the LiDAR" in answer
    asking.tuning.observe(StateChange(2.0, state, State.HOLDING, Cause.AT_REST))
    assert asking.ask(FASTER) == ""


def test_late_and_outdated_requests_are_refused(asking: Asking, clock: Clock):
    seen = clock.now
    waiting = asking.submit(FASTER)
    clock.now += 1.01 * AGE_MAX
    assert asking.take() is None and "it was under way for 2 s" in str(waiting.answer)
    for time in (seen, clock.now + 1.0, math.nan, None, "now", 10**400, True):
        assert "under way" in asking.ask(FASTER, time=time)
    assert asking.ask(FASTER) == ""
    for version in (0, 2, None, "1"):
        assert "the parameters have changed meanwhile" in asking.ask({"costs.q_track": 8.0}, version=version)


def test_one_change_waits_at_a_time_and_none_of_a_sender_who_is_gone(asking: Asking):
    first, second = asking.submit(FASTER), asking.submit({"costs.q_track": 8.0})
    assert first.answer is None and "another change waits" in str(second.answer)
    first.abandoned = True
    third = asking.submit({"costs.q_track": 9.0})
    assert asking.take() is not None and third.answer == "" and first.answer is None
    fourth = asking.submit(FASTER)
    fourth.abandoned = True
    assert asking.take() is None and asking.tuning.config == SMALL.replace({"costs.q_track": 9.0})


def test_a_planner_that_fails_keeps_its_parameters(asking: Asking):
    def fail(_: PlannerConfig) -> None:
        raise RuntimeError("out of memory")

    request = asking.submit(FASTER)
    assert asking.tuning.take(fail) is None
    assert request.answer == "out of memory" and asking.tuning.config == SMALL and asking.tuning.version == 0


# --- the way back ---


def test_undo_goes_back_step_by_step_and_takeoff_in_one(asking: Asking):
    tuning = asking.tuning
    assert "nothing would change" in asking.ask(step="undo") and not tuning.status(None)["can_undo"]
    assert asking.ask({"costs.q_track": 8.0}) == ""
    tuning.observe(sample(armed=True))  # it takes off with this one
    for limit in (2.0, 3.0, 4.0):
        assert asking.ask({"vehicle.speed_limit": limit}, confirmed=True) == ""
    assert asking.ask(step="undo") == "" and tuning.config.vehicle.speed_limit == 3.0
    assert not tuning.status(None)["at_takeoff"]
    assert asking.ask(step="takeoff") == "" and tuning.config == SMALL.replace({"costs.q_track": 8.0})
    assert tuning.status(None)["at_takeoff"]
    for limit in (3.0, 2.0, 5.0):
        assert asking.ask(step="undo") == "" and tuning.config.vehicle.speed_limit == limit
    assert asking.ask(step="undo") == "" and tuning.config == SMALL and tuning.version == 10
    assert not tuning.status(None)["can_undo"]


# --- in the node ---


class Seen(Observer):
    """Keeps the changes of the configuration, and the number of the first plan after each."""

    def __init__(self) -> None:
        self.changes: list[ConfigChange] = []

    def observe(self, item: Observation) -> None:
        if isinstance(item, ConfigChange):
            self.changes.append(item)


def submit(tuning: Tuning, simulation: Simulation, changes: dict[str, Any], number: int = 1) -> Request:
    content = {"time": simulation.now, "version": tuning.version, "changes": changes, "confirmed": True}
    request = Request(number, "tester", content)
    tuning.submit(request)
    return request


def test_the_node_flies_changed_parameters_and_logs_them(small_planner: Planner, tmp_path: Path):
    seen, relay = Seen(), Relay()
    simulation: Simulation
    tuning = Tuning(SMALL, ONBOARD, KEY, clock=lambda: simulation.now)
    simulation = Simulation(small_planner, poles(CORRIDOR), GOAL, observers=[relay], tuning=tuning)
    log = FlightLog(tmp_path / "flight.mcap", SMALL, ONBOARD, clock=lambda: simulation.now)
    relay.observers = [seen, log]
    simulation.engage()
    simulation.run(0.5)
    request = submit(tuning, simulation, {"vehicle.speed_limit": 2.0})
    assert request.answer is None and small_planner.config == SMALL
    simulation.run(0.2)
    assert request.answer == "" and small_planner.config.vehicle.speed_limit == 2.0
    # A velocity that is uncertain still halves the limit, and a change does not lift that.
    simulation.link.velocity_std = 0.49
    simulation.run(0.2)
    assert small_planner.config.vehicle.speed_limit == pytest.approx(1.0)
    assert submit(tuning, simulation, {"vehicle.speed_limit": 4.0}, 2).answer is None
    simulation.run(0.2)
    assert small_planner.config.vehicle.speed_limit == pytest.approx(2.0)
    assert tuning.config.vehicle.speed_limit == 4.0
    simulation.link.velocity_std = 0.05
    simulation.run(0.2)
    assert small_planner.config == tuning.config
    # A drone that brakes keeps its parameters.
    simulation.lidar.alive = False
    assert simulation.run_until(lambda: simulation.node.state is State.BRAKING, 2.0)
    assert "the drone is braking" in str(submit(tuning, simulation, {"vehicle.speed_limit": 3.0}, 3).answer)
    simulation.node.close()
    assert [change.version for change in seen.changes] == [1, 2]
    with log.path.open("rb") as file:
        texts = {entry.name: entry.data.decode() for entry in make_reader(file).iter_attachments()}
    limits = {}
    for name in texts:
        if name.startswith("config"):
            config = ConfigFile(name, parse_entries(texts[name], name)).planner_config(PlannerConfig)
            limits[name] = config.vehicle.speed_limit
    assert limits == {"config_0.yaml": 5.0, "config_1.yaml": 2.0, "config_2.yaml": 4.0}
    versions = [plan.config_version for _, plan in decoded(log.path)["/plan"]]
    assert sorted(set(versions)) == [0, 1, 2] and versions == sorted(versions), "every plan names its configuration"
