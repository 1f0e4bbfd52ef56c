"""The table of transitions, checked for every input with at most two faults."""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aero_planner import PlanStatus
from aero_planner.onboard.failsafe_conditions import cause_applies, find_faults, is_inside_fence, next_state
from aero_planner.onboard.failsafe_table import (
    DETECTION,
    FAULTS,
    HARMLESS_AT_REST,
    REACTIONS,
    TRANSITIONS,
    Cause,
    Inputs,
    Reaction,
    State,
)
from aero_planner.onboard.safety_docs import format_diagram, format_failsafes, format_states
from tests.planner.onboard.safety_inputs import LIMITS, WELL, check_one_step

DOCS = Path(__file__).parents[3] / "docs" / "onboard_safety.md"
# Faults, and the inputs that they change. Ages are just beyond their limit, NaN, or far beyond the limit.
BREAKS: dict[str, dict[str, object]] = {
    "link": {"heartbeat_age": LIMITS.heartbeat_age + 0.1},
    "link late": {"round_trip": LIMITS.round_trip + 0.01},
    "link still late": {"round_trip": 0.9 * LIMITS.round_trip, "link_was_late": True},
    "link no longer measured": {"link_was_late": True},
    "link gone": {"heartbeat_age": math.inf},
    "state": {"state_age": LIMITS.state_age + 0.01},
    "state gone": {"state_age": LIMITS.state_age + LIMITS.blind_time + 0.01},
    "state age unknown": {"state_age": math.nan},
    "state not finite": {"state_finite": False, "speed": math.nan, "goal_distance": math.nan},
    "fix lost": {"fix_age": LIMITS.fix_age + 0.01},
    "position uncertain": {"position_std": LIMITS.position_std + 0.01},
    "velocity uncertain": {"velocity_std": math.inf},
    "uncertainty still too large": {"velocity_std": 0.9 * LIMITS.velocity_std, "estimate_was_poor": True},
    "fence": {"inside_fence": False},
    "transmitter": {"transmitter_lost": True},
    "battery": {"battery_low": True},
    "floor": {"inside_fence": False, "below_floor": True},
    "overrun": {"loop_age": LIMITS.deadline + 0.01},
    "loop gone": {"loop_age": LIMITS.deadline + LIMITS.blind_time + 0.01},
    "cloud": {"cloud_age": math.inf},
    "cloud age unknown": {"cloud_age": math.nan},
    "plan": {"plan_age": LIMITS.plan_age + 0.01},
    "no plan": {"plan_age": math.inf},
    "plan not finite": {"plan_finite": False},
    "unsafe": {"plan_status": PlanStatus.NO_SAFE_CANDIDATE},
    "stale for the planner": {"plan_status": PlanStatus.STALE_CLOUD},
    "on the ground": {"in_air": False},
    "landed state unknown": {"in_air": None},
    "another vehicle": {"supported": False},
    "no failsafe process": {"guarded": False},
    "no date": {"clock_set": False},
    "cloud turns": {"drift_angle": math.radians(LIMITS.drift_angle) + 0.01},
    "cloud moves": {"drift_speed": LIMITS.drift_speed + 0.01},
    "cloud still moves too much": {"drift_speed": 0.9 * LIMITS.drift_speed, "cloud_drifted": True},
    "cloud no longer measured": {"drift_speed": math.nan, "drift_angle": math.nan, "cloud_drifted": True},
}


def every_input() -> Iterator[Inputs]:
    """Yield all inputs with at most two faults, in every mode, at rest or moving, before and after time limits."""
    broken = [(), *itertools.combinations(BREAKS, 1), *itertools.combinations(BREAKS, 2)]
    for names in broken:
        base = WELL
        for name in names:
            base = dataclasses.replace(base, **BREAKS[name])  # type: ignore[arg-type]
        for armed, offboard, stopping, seen, slow, near, long in itertools.product((True, False), repeat=7):
            yield dataclasses.replace(
                base,
                armed=armed,
                offboard=offboard,
                stopping=stopping,
                seen_disarmed=seen or not armed,
                speed=0.1 if slow and not math.isnan(base.speed) else base.speed,
                goal_distance=0.2 if near and not math.isnan(base.goal_distance) else base.goal_distance,
                state_time=100.0 if long else 0.1,
                fault_time=100.0 if long else 0.1,
            )


ALL_INPUTS = tuple(every_input())


@pytest.mark.parametrize("state", State, ids=lambda state: state.name)
def test_invariants_hold_for_every_input(state: State):
    for inputs in ALL_INPUTS:
        check_one_step(state, inputs, next_state(state, inputs, LIMITS)[0])


def test_every_row_can_be_taken_and_every_cause_is_used():
    taken = set()
    for state, inputs in itertools.product(State, ALL_INPUTS):
        for row in TRANSITIONS:
            if state in row.sources and cause_applies(row.cause, inputs, LIMITS):
                taken.add(row)
                break
    assert taken == set(TRANSITIONS)
    assert {row.cause for row in TRANSITIONS} == set(Cause)
    assert set(DETECTION) >= set(FAULTS) and set(REACTIONS) == set(State)


def test_no_state_is_a_dead_end():
    """Without faults, a pilot who lands, disarms and tries again reaches FLYING from every state."""
    patient = dataclasses.replace(WELL, armed=False, offboard=False), dataclasses.replace(WELL, offboard=False), WELL
    for start in State:
        state = start
        for inputs in patient:
            for _ in range(3):
                state, _ = next_state(state, inputs, LIMITS)
        assert state is State.FLYING, start


def test_persistent_faults_end_in_silence_or_at_rest():
    """No persistent input causes an endless chain of transitions, or a flight with faults."""
    for state, inputs in itertools.product(State, ALL_INPUTS):
        chain = [state]
        while (target := next_state(chain[-1], inputs, LIMITS)[0]) is not chain[-1]:
            chain.append(target)
            assert len(chain) < 8, (chain, inputs)
        broken = find_faults(inputs, LIMITS)
        if broken:
            assert REACTIONS[chain[-1]] is not Reaction.STREAM_PLAN
        if broken and inputs.fault_time > LIMITS.brake_time + LIMITS.hold_time:
            resting = chain[-1] is State.ARRIVED and set(broken) <= set(HARMLESS_AT_REST)
            assert REACTIONS[chain[-1]] is Reaction.SILENT or resting


def test_the_fence_is_a_cylinder_and_a_box():
    limits = dataclasses.replace(LIMITS, fence_radius=10.0, fence_x_max=5.0, fence_y_min=-2.0)
    assert is_inside_fence((0.0, 0.0, 1.0), limits) and is_inside_fence((-9.9, 0.0, 30.0), limits)
    outside = [(6.0, 0, 1), (0, -2.1, 1), (-10.1, 0, 1), (-8, 8, 1), (0, 0, 0.2), (0, 0, 30.1), (math.nan, 0, 1)]
    assert not any(is_inside_fence(np.array(place), limits) for place in outside)


def test_the_documentation_shows_the_table_that_is_flown():
    text = DOCS.read_text(encoding="utf-8")
    assert f"```mermaid\n{format_diagram()}\n```" in text
    assert f"\n{format_states()}\n" in text and f"\n{format_failsafes()}\n" in text
    for state in State:
        assert state.name in format_diagram()
