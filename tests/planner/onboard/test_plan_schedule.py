from dataclasses import replace

import numpy as np
import pytest

from aero_planner import PlanStatus
from aero_planner.onboard.braking_path import BrakingPath
from aero_planner.onboard.plan_schedule import PlanSchedule, ScheduledPlan


def scheduled(number: int, time: float, *, steps: int = 5, dt: float = 0.05) -> ScheduledPlan:
    controls = np.arange(4.0 * steps).reshape(steps, 4) + 100.0 * number
    return ScheduledPlan(number, time, time, dt, controls, PlanStatus.OK)


@pytest.mark.parametrize("start", [0.0, 0.1, 12345.678, 1e6 + 0.3])
def test_the_command_at_a_time_is_that_of_its_step(start: float):
    plan = scheduled(0, start)
    for step in range(5):
        for within in (0.0, 0.01, 0.049):
            command = plan.command(start + 0.05 * step + within)
            assert command is not None and command[0] == 4.0 * step
    assert plan.command(start - 0.001) is None and plan.command(start + 0.25) is None


def test_the_previous_plan_is_flown_until_the_newest_begins():
    schedule = PlanSchedule()
    assert schedule.at(0.0) is None and schedule.command(0.0) is None
    schedule.append(scheduled(1, 10.0), 9.95)
    schedule.append(scheduled(2, 10.1), 10.05)
    for now, first in ((10.06, 104.0), (10.1, 200.0), (10.34, 216.0)):
        command = schedule.command(now)
        assert command is not None and command[0] == first
    assert schedule.command(10.36) is None and schedule.command(9.9) is None
    schedule.append(scheduled(3, 10.5), 10.36)
    newest = schedule.at(10.5)
    assert newest is not None and newest.number == 3
    assert schedule.command(10.36) is None  # a plan is never flown beyond its end


def test_the_present_plan_is_kept_however_many_wait_to_begin():
    schedule = PlanSchedule()
    for number, time, now in ((1, 10.0, 9.9), (2, 10.1, 10.0), (3, 10.25, 10.1), (4, 10.24, 10.12), (5, 10.26, 10.15)):
        schedule.append(scheduled(number, time), now)
    for now, number in ((10.15, 2), (10.23, 2), (10.24, 4), (10.27, 5)):
        plan = schedule.at(now)
        assert plan is not None and plan.number == number
    # Plans that are no longer needed are discarded.
    for number in range(6, 100):
        schedule.append(scheduled(number, 10.26), 10.26 + 0.05 * number)
    assert len(schedule) == 2


def test_a_braking_path_from_before_a_reset_is_not_used():
    path = BrakingPath(0.05, np.zeros((2, 3)), np.zeros((2, 3)))
    schedule = PlanSchedule()
    assert schedule.path(-np.inf) is None
    schedule.append(replace(scheduled(1, 5.0), path=path), 5.0)
    assert schedule.path(5.0) is path and schedule.path(5.01) is None
