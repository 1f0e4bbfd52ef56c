"""The command `aero-planner rig`: its arguments and its output."""

import numpy as np
import pytest

from aero_viz.rig import Event, Intervals, RigResult, Trajectory
from aero_viz.rig.command import format_result, main
from aero_viz.rig.faults import FAULT_KINDS


def test_help_lists_every_kind_of_fault(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert all(kind in text for kind in FAULT_KINDS)


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["forrest"], "forest"),
        (["missing.json"], "missing.json"),
        (["forest", "--fault", "drop"], "is not a fault"),
        (["forest", "--fault", "burn@3"], "no fault 'burn'"),
        (["forest", "--count", "0"], "positive"),
        (["forest", "--duration", "-3"], "positive"),
        (["forest", "--speed", "1000"], "speed_limit"),
        (["forest", "--config", "missing.yaml"], "missing.yaml"),
        (["forest", "--config", "px4", "--speed", "1000"], "speed_limit"),  # the preset is accepted
        (["forest", "--config", "px5"], "neither a preset .did you mean 'px4'.. nor a file"),
        (["forest", "--autopilot", "px4"], "needs --px4 DIR"),
        (["forest", "--autopilot", "px4", "--px4", "missing"], "missing is not a folder"),
        (["forest", "--px4", "."], "need --autopilot px4"),
        (["forest", "--parameter", "SIH_KDV=1"], "need --autopilot px4"),
    ],
)
def test_a_mistake_is_reported_in_one_sentence(arguments, error):
    with pytest.raises(ValueError, match=error) as raised:
        main(arguments)
    assert "\n" not in str(raised.value)


def test_the_result_is_printed_in_a_few_lines():
    empty = np.zeros((0, 3))
    result = RigResult(
        arrived=True, reason="arrived", arrivals=1, flight_time_s=9.3, mean_speed=4.6, max_speed=5.2,
        min_clearance=0.71, scene="forest", seed=3, faults=[], events=[Event(9.3, "arrived")], setpoints=465,
        refused=0, violations=[], intervals=Intervals(464, 0.02, 0.0004, 0.0212, 0.031, 1),
        sign_changes=(1.5, 2.04, 0.0), overruns=0, log=[],
        trajectory=Trajectory(empty[:, 0], empty, empty, empty[:, 0] > 0.0), commands=[],
    )  # fmt: skip
    assert format_result(result).splitlines() == [
        "forest 3: arrived after 9.3 s, 4.6 m/s, at most 5.2 m/s, 0.71 m from the nearest surface",
        "setpoints: 464, every 20.0 ms, jitter 0.40 ms, 99 % within 21.2 ms, longest 31 ms, 1 missed",
        "setpoints: 1.5, 2.0, 0.0 sign changes per second in roll, pitch, yaw",
    ]
