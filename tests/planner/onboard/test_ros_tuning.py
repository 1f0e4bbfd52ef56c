"""Sets of parameters in ROS: what confirms one, and what is answered. Over a real graph: tests/ros/test_onboard.py."""

import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.failsafe_table import Cause, State
from aero_planner.onboard.ros_tuning import RosTuning
from aero_planner.onboard.safety_machine import StateChange
from aero_planner.onboard.tuning import Tuning
from tests.planner.onboard.simulated import SMALL, Clock
from tests.planner.onboard.test_tuning import KEY, ONBOARD, sample

FASTER: dict[str, float] = {"vehicle.speed_limit": 6}
SLOWER: dict[str, float] = {"vehicle.speed_limit": 2.0}


class Node:
    """A node that plans whenever somebody waits for it, and a program in ROS that sets its parameters."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.plans = clock, True
        self.tuning = Tuning(SMALL, ONBOARD, KEY, clock=clock)
        self.tuning.observe(sample(armed=False))
        self.configured: list[PlannerConfig] = []
        self._ros = RosTuning(self.tuning, clock=clock, sleep=self._sleep)

    def _sleep(self, seconds: float) -> None:
        self.clock.now += seconds
        if self.plans:
            self.tuning.take(self.configured.append)

    def set(self, changes: dict[str, float], *, after: float = 0.0) -> str:
        """Return why a set is refused, an empty text if it is in force."""
        self.clock.now += after
        try:
            self._ros.ask(changes)
        except ValueError as error:
            return str(error)
        assert changes.items() <= self._ros.current()[1].items()
        return ""


@pytest.fixture
def node(clock: Clock) -> Node:
    return Node(clock)


@pytest.fixture
def armed(node: Node) -> Node:
    node.tuning.observe(sample(armed=True))
    return node


def test_a_set_is_answered_after_the_plan_that_takes_it(node: Node):
    assert node.set(FASTER) == "" and node.configured == [SMALL.replace(FASTER)]
    assert node.set(FASTER) == "" and node.tuning.version == 1  # it is in force already


def test_the_parameters_are_those_of_the_limits_with_their_bounds(node: Node):
    infos, values = RosTuning(node.tuning).current()
    assert [(info.path, info.high) for info in infos if info.is_number] == [
        ("vehicle.speed_limit", 6.0), ("costs.q_track", 30.0),
    ]  # fmt: skip
    assert values == {info.path: SMALL.get(info.path) for info in infos}


def test_an_armed_drone_takes_the_second_of_two_equal_sets(armed: Node):
    assert "armed, and the change was not confirmed. Set the same again within 5 s" in armed.set(FASTER)
    assert armed.set(FASTER, after=1.0) == "" and armed.configured == [SMALL.replace(FASTER)]
    assert "not confirmed" in armed.set(SLOWER, after=1.0)


def test_other_sets_late_ones_and_the_echo_of_a_slider_confirm_nothing(armed: Node):
    for changes, after in ((FASTER, 0.0), (SLOWER, 1.0), (FASTER, 1.0), (FASTER, 5.5), (FASTER, 0.1), (FASTER, 0.1)):
        assert "not confirmed" in armed.set(changes, after=after)
    assert armed.configured == []
    assert armed.set(FASTER, after=1.0) == ""


def test_a_change_by_somebody_else_takes_the_confirmation_away(armed: Node):
    assert "not confirmed" in armed.set(FASTER)
    armed.tuning.observe(sample(armed=False))
    assert armed.set({"costs.q_track": 6.0}) == ""
    armed.tuning.observe(sample(armed=True))
    assert "not confirmed" in armed.set(FASTER, after=1.0)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [({"vehicle.speed_limit": 6.1}, "a number in [1, 6]"), ({"vehicle.mass": 2.0}, "can't be changed")],
)
def test_what_the_limits_forbid_is_refused_before_it_is_to_be_confirmed(
    armed: Node, changes: dict[str, float], problem: str
):
    reason = armed.set(changes)
    assert problem in reason and "again" not in reason


def test_nothing_changes_while_the_drone_brakes(armed: Node):
    assert "not confirmed" in armed.set(FASTER)
    armed.tuning.observe(StateChange(1.0, State.FLYING, State.BRAKING, Cause.CLOUD_STALE))
    assert "braking" in armed.set(FASTER, after=1.0) and armed.configured == []


def test_what_no_plan_has_taken_is_refused_and_never_taken(node: Node):
    node.plans = False
    assert "taken no change" in node.set(FASTER)
    assert node.tuning.take(node.configured.append) is None and node.configured == []
