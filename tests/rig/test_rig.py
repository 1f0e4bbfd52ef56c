"""Whole flights on the rig, in real time, with a companion that needs no planner."""

import sys
from pathlib import Path

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.rig import Fault, fly_rig
from aero_viz.rig.offboard import Mode, Setpoint
from aero_viz.rig.process import NodeProcess
from aero_viz.rig.result import intervals_of, sign_changes_of
from aero_viz.scenes import World

pytestmark = pytest.mark.realtime

STREAM = Path(__file__).with_name("stream.py")


def companion(speed):
    return [sys.executable, str(STREAM), "{config}", str(speed)]


@pytest.fixture
def world():
    post = [20.0, 3.0, 0, 0, 0, 1, 0.5, 10]
    return World("post", np.array([0.0, 0, 2]), np.array([6.0, 0, 2]), cylinders=np.array([post]))


def event_texts(result):
    return [event.text for event in result.events]


def test_a_flight_arrives(world):
    result = fly_rig(world, command=companion(3.0), duration=20.0)
    assert result.arrived, (result, result.log)
    assert event_texts(result) == [
        "node started", "pilot arms and takes off", "pilot switches to OFFBOARD, autopilot accepts", "arrived",
    ]  # fmt: skip
    assert np.linalg.norm(result.trajectory.positions[-1] - world.goal) < 1.0
    assert 2.0 < result.max_speed < 3.5
    assert result.min_clearance is not None and result.min_clearance > 1.0
    assert result.trajectory.offboard.all()
    assert result.violations == []
    assert result.refused == 0
    assert result.intervals is not None
    assert result.intervals.mean == pytest.approx(0.02, rel=0.02)
    assert result.setpoints == result.intervals.count + 1
    assert result.log == ["streaming"]
    assert set(result.to_dict()) >= {"arrived", "reason", "intervals", "events"}


def test_a_shuttle_flies_back_and_forth_until_the_time_is_over(world):
    near = World("near", world.start, np.array([2.0, 0, 2]), cylinders=world.cylinders)
    result = fly_rig(near, command=companion(3.0), duration=8.0, shuttle=True)
    assert result.arrived
    assert result.arrivals >= 2
    assert result.flight_time_s == pytest.approx(8.0, abs=0.01)


def test_an_obstacle_in_the_way_is_hit(world):
    wall = World("wall", world.start, world.goal, boxes=np.array([[3.0, 0, 2, 0.2, 4, 4, 0]]))
    result = fly_rig(wall, command=companion(3.0), duration=20.0)
    assert result.reason == "collision"
    assert result.min_clearance is not None and result.min_clearance < 0.25
    # The flight ends there: within a few steps.
    assert result.trajectory.positions[-1, 0] < 3.0


def test_the_autopilot_takes_over_from_a_paused_companion(world):
    far = World("far", world.start, np.array([60.0, 0, 2]), cylinders=world.cylinders)
    result = fly_rig(far, command=companion(3.0), faults=[Fault("pause-node", 1.5, 2.0)], duration=8.0)
    leaves = next(event for event in result.events if "leaves OFFBOARD" in event.text)
    assert leaves.time == pytest.approx(2.0, abs=0.1)
    assert result.reason == "held"
    assert result.trajectory.speeds()[-1] < 0.2
    # Setpoints after the pause were not obeyed.
    assert {c.mode for c in result.commands if c.time > result.commands[0].time + 6.0} <= {Mode.HOLD}


def test_a_program_that_ends_at_once_is_not_ready(world):
    result = fly_rig(world, command=[sys.executable, "-c", "print('no can do'); raise SystemExit(3)"])
    assert result.reason == "not_ready"
    assert result.log == ["no can do"]
    assert result.setpoints == 0


def test_processes_end_even_when_paused_or_ignoring_signals():
    deaf = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('up', flush=True)\ntime.sleep(60)"
    process = NodeProcess(PlannerConfig(), OnboardConfig(), command=[sys.executable, "-c", deaf], patience=0.2)
    process.start()
    while not process.log():
        assert process.running
    process.pause()
    process.close()
    assert not process.running


def test_a_process_gets_its_configuration():
    config = PlannerConfig().replace({"vehicle.speed_limit": 3.5})
    onboard = OnboardConfig().replace({"limits.plan_age": 0.25})
    show = "import sys; print(open(sys.argv[1]).read())"
    process = NodeProcess(config, onboard, command=[sys.executable, "-c", show, "{config}"])
    process.start()
    while process.running:
        pass
    text = "\n".join(process.log())
    process.close()
    assert "speed_limit: 3.5" in text
    assert "plan_age: 0.25" in text


def test_intervals():
    times = [0.0, 0.02, 0.04, 0.07, 0.13, 0.15]
    setpoints = [Setpoint(t, 9.81, (0.0, 0.0, 0.0), None, Mode.OFFBOARD) for t in times]
    before = Setpoint(-5.0, 9.81, (0.0, 0.0, 0.0), None, Mode.HOLD)
    result = intervals_of([before, *setpoints], 0.02)
    assert result is not None
    assert result.count == 5
    assert result.mean == pytest.approx(0.03)
    assert result.longest == pytest.approx(0.06)
    # 30 ms misses one, 60 ms two.
    assert result.missed == 1 + 2
    assert intervals_of(setpoints[:1], 0.02) is None


def test_sign_changes():
    """A change counts in OFFBOARD, and beyond 0.05 rad/s."""
    rates = [(0.1, 0.1, 0.04), (-0.1, 0.04, -0.04), (-0.2, -0.04, 0.04), (0.1, 0.2, -0.04), (-0.3, -0.06, 0.3)]
    setpoints = [Setpoint(0.5 * i, 9.81, rate, None, Mode.OFFBOARD) for i, rate in enumerate(rates)]
    before = Setpoint(-1.0, 9.81, (-1.0, -1.0, -1.0), None, Mode.HOLD)
    assert sign_changes_of([before, *setpoints]) == pytest.approx((1.5, 0.5, 0.0))
    assert sign_changes_of([before, setpoints[0]]) is None
