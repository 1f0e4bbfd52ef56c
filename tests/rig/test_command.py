"""The command `aero-planner rig`: its arguments and its output."""

import pytest

from aero_viz.rig.command import format_result, main
from aero_viz.rig.faults import FAULT_KINDS
from tests.rig.results import RESULT


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
    assert format_result(RESULT).splitlines() == [
        "forest 3: arrived after 9.3 s, 4.6 m/s, at most 5.2 m/s, 0.71 m from the nearest surface",
        "setpoints: 464, every 20.0 ms, jitter 0.40 ms, 99 % within 21.2 ms, longest 31 ms, 1 missed",
        "setpoints: 1.5, 2.0, 0.0 sign changes per second in roll, pitch, yaw",
    ]
