"""The start of a flight with PX4, against a program that speaks like it."""

import contextlib
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.onboard.connections import thrust_model
from aero_planner.onboard.mavlink import MavlinkLink
from aero_planner.onboard.px4_parameters import read_parameters
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.errors import UserError
from aero_viz.rig.px4_autopilot import Px4Autopilot
from aero_viz.rig.px4_process import HOST, Px4Process
from aero_viz.rig.px4_setup import set_parameters
from tests.rig.test_px4 import program

VEHICLE, ONBOARD = PlannerConfig().vehicle, OnboardConfig()
LIKE_PX4 = Path(__file__).parent / "px4_like.py"
LOCKSTEP, REAL_TIME = 0.25, 1.0


@pytest.fixture
def lame(monkeypatch: pytest.MonkeyPatch) -> None:
    """A PX4 whose simulator does not start."""
    monkeypatch.setenv("SIMULATOR_FAILS", "1")


@pytest.fixture
def px4(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Px4Process]:
    """A program that speaks like PX4, at the speed that the test asks for."""
    program(tmp_path, f'exec "{sys.executable}" "{LIKE_PX4}" "$@"')
    process = Px4Process(tmp_path, speed=request.param)
    yield process
    process.close()


@pytest.mark.parametrize("px4", [LOCKSTEP, REAL_TIME], indirect=True, ids=["lockstep", "real time"])
def test_parameters_are_set_and_the_origin_is_found_however_slow_the_heartbeats_are(px4: Px4Process):
    changes = set_parameters(px4, ONBOARD, VEHICLE, {"MIS_TAKEOFF_ALT": 2.0})
    assert {change.name: change.value for change in changes} == {
        "COM_OF_LOSS_T": 0.2, "COM_OBL_RC_ACT": 5, "COM_RC_OVERRIDE": 3, "COM_RCL_EXCEPT": 4, "NAV_RCL_ACT": 1,
        "MIS_TAKEOFF_ALT": 2.0,
    }  # fmt: skip
    autopilot = Px4Autopilot(
        px4, (HOST, 9), origin=np.array([1.0, 2.0, 0.0]), heading=0.0, thrust=thrust_model(ONBOARD, VEHICLE)
    )
    try:
        # PX4 stands half a metre above the origin of its estimator.
        np.testing.assert_allclose(autopilot.local(np.array([1.0, 2.0, 0.0])), [0.0, 0.0, 0.5], atol=1e-6)
    finally:
        autopilot.close()


@pytest.mark.parametrize("px4", [REAL_TIME], indirect=True, ids=["real time"])
def test_faults_of_the_simulated_sensors_and_battery_reach_px4_in_its_own_types(px4: Px4Process):
    set_parameters(px4, ONBOARD, VEHICLE, {})
    thrust = thrust_model(ONBOARD, VEHICLE)
    autopilot = Px4Autopilot(px4, (HOST, 9), origin=np.zeros(3), heading=0.0, thrust=thrust)
    try:
        autopilot.lose_position()
        autopilot.drain_battery()
    finally:
        autopilot.close()
    wanted = {"SIM_GPS_USED": 0.0, "SIM_BAT_MIN_PCT": 20.0, "SIM_BAT_DRAIN": 1.0, "BAT_LOW_THR": 0.5}
    with contextlib.closing(MavlinkLink(f"udpin:{HOST}:{px4.companion_remote}", thrust, system=px4.system)) as link:
        # The first answer may be from before what waits on the other connection.
        present = [read_parameters(link, wanted) for _ in range(5)][-1]
    assert present == wanted


@pytest.mark.parametrize("px4", [REAL_TIME], indirect=True, ids=["real time"])
def test_what_px4_wrote_is_kept_where_it_runs_on_without_a_part(
    lame: None, px4: Px4Process, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("aero_viz.rig.px4_autopilot._TRUTH_TIME", 0.5)
    set_parameters(px4, ONBOARD, VEHICLE, {})
    with pytest.raises(UserError, match="does not report a position") as caught:
        Px4Autopilot(px4, (HOST, 9), origin=np.zeros(3), heading=0.0, thrust=thrust_model(ONBOARD, VEHICLE))
    px4.close()
    match = re.search(r"all that it wrote: (.*)\)", str(caught.value))
    assert match is not None and "simulator_sih" in Path(match[1]).read_text()
    os.remove(match[1])


@pytest.mark.parametrize("px4", [LOCKSTEP], indirect=True, ids=["lockstep"])
def test_a_parameter_that_px4_lacks_is_an_error(px4: Px4Process):
    with pytest.raises(UserError, match="PX4 has no parameter NOT_THERE"):
        set_parameters(px4, ONBOARD, VEHICLE, {"NOT_THERE": 1.0})
