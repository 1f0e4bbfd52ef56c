import math
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings

from aero_planner import PlannerConfig
from aero_planner.config.file import format_config
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.flight_config import format_onboard, load_any, load_flight_config, load_onboard
from aero_planner.onboard.settings import OnboardConfig
from aero_planner.parameters import ParameterInfo
from tests.planner.config_cases import configs, write

NUMBERS = [info for info in OnboardConfig.parameters() if info.is_number]

every_setting = pytest.mark.parametrize("info", OnboardConfig.parameters(), ids=lambda info: info.path)
every_number = pytest.mark.parametrize("info", NUMBERS, ids=lambda info: info.path)


@every_setting
def test_every_setting_is_described_and_its_default_is_valid(info: ParameterInfo):
    assert info.help[0].isupper() and info.help.endswith(".") and len(info.help) < 300
    assert info.check(info.default) == info.default == OnboardConfig().get(info.path)
    assert not isinstance(info.default, float) or info.unit or info.name in ("hover_thrust", "curve")


def test_labels_are_unique_within_a_section():
    names = [(info.section, info.label) for info in OnboardConfig.parameters()]
    assert len(names) == len(set(names))
    assert all(label[0].isupper() and not label.endswith(".") for _, label in names)


@every_number
def test_errors_name_setting_value_and_range(info: ParameterInfo):
    for wrong in (info.high * 2 + 1, info.low - 1, math.nan, math.inf, "5", None, True):
        with pytest.raises(ValueError) as raised:
            OnboardConfig().replace({info.path: wrong})  # type: ignore[dict-item]
        message = str(raised.value)
        assert message.startswith(f"{info.path} is {wrong!r}; it must be a")
        assert f"[{info.low:g}, {info.high:g}]" in message


@pytest.mark.parametrize("path", ["lidar.host", "mavlink.url", "telemetry.host"])
@pytest.mark.parametrize("wrong", ["", "a b", "x#y", 5, None, "a\nb"])
def test_texts_must_match_their_pattern(path: str, wrong: object):
    with pytest.raises(ValueError, match=rf"{path} is .*it must be an? "):
        OnboardConfig().replace({path: wrong})  # type: ignore[dict-item]


@pytest.mark.parametrize(
    ("path", "right", "wrong"),
    [
        (
            "mavlink.url",
            [
                "udpin:0.0.0.0:14540",
                "udpout:drone-3.local:65535",
                "/dev/ttyTHS1",
                "/dev/serial/by-id/usb-3D_R:1-if00",
            ],
            ["udpin:14540", "udpin:0.0.0.0:65536", "udpin:300.0.0.1:14540", "tcp:127.0.0.1:5760", "COM3", "14540"],
        ),
        (
            "lidar.host",
            ["0.0.0.0", "255.255.255.255", "jetson-3"],
            ["999.1.1.1", "1.2.3", "1.2.3.4.5", "1"],
        ),
        ("lidar.sensor", ["any", "192.168.1.142", "3d.lidar"], ["192.168.1.256", "::1"]),
        ("telemetry.host", ["::", "fe80::1", "127.0.0.1"], ["127.0.0.256", "127.1"]),
        (
            "mavlink.goal_senders",
            ["vehicle", "1@autopilot", "vehicle,255@autopilot,255@192.168.1.20,9@station"],
            ["999@autopilot", "256@autopilot", "0@autopilot", "255@192.168.1.300", "255"],
        ),
    ],
)
def test_addresses_that_can_never_work_are_refused(path: str, right: list[str], wrong: list[str]):
    for value in right:
        assert OnboardConfig().replace({path: value}).get(path) == value
    for value in wrong:
        with pytest.raises(ValueError, match=re.escape(f"{path} is {value!r}; it must be ")):
            OnboardConfig().replace({path: value})


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"limits.fence_height_min": 40.0}, "limits.fence_height_min is 40.0; it must be less than"),
        ({"limits.fence_x_max": -1e5}, "limits.fence_x_min is"),
        (
            {"rates.replan": 5.0},
            "limits.plan_age is 0.3; with a rates.replan of 5 Hz it must be at least 0.4 s",
        ),
        (
            {"rates.control": 10.0},
            "limits.deadline is 0.1; with a rates.control of 10 Hz it must be at least 0.2 s",
        ),
        ({"limits.plan_agee": 1.0}, "unknown setting 'limits.plan_agee' (did you mean 'limits.plan_age'?)"),
        ({"rates.plan_age": 1.0}, "did you mean 'limits.plan_age'?"),
    ],
)
def test_contradictions_and_unknown_names(changes: dict, problem: str):
    with pytest.raises(ValueError) as raised:
        OnboardConfig().replace(changes)
    assert problem in str(raised.value)


def test_planner_and_node_must_not_contradict_each_other():
    check_together(PlannerConfig(), OnboardConfig())
    with pytest.raises(ValueError, match="less than the planner's horizon"):
        check_together(PlannerConfig().replace({"sampling.steps": 4}), OnboardConfig())
    with pytest.raises(ValueError, match=r"must exceed the weight of 19\.62 N"):
        check_together(PlannerConfig().replace({"vehicle.mass": 2.0}), OnboardConfig())


@hypothesis_settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(configs(OnboardConfig))
def test_written_files_round_trip_and_read_the_same_with_any_yaml_reader(tmp_path: Path, config: OnboardConfig):
    path = write(tmp_path / "node.yaml", format_onboard(config))
    assert load_onboard(path) == config
    assert yaml.safe_load(path.read_text()) == {"onboard": config.to_dict()}


def test_one_file_may_hold_planner_and_node(tmp_path: Path):
    planner = PlannerConfig.preset("paper").replace({"costs.q_track": 7.0})
    onboard = OnboardConfig().replace({"limits.plan_age": 0.25, "mavlink.url": "/dev/ttyTHS1"})
    path = write(tmp_path / "both.yaml", format_config(planner) + "\n" + format_onboard(onboard))
    assert load_flight_config(path) == (planner, onboard) == load_any(path)
    # The node may come first, and comments may be anywhere.
    text = "# mine\nonboard: # node\n  limits:\n  # less\n    plan_age: 0.2\n\ncosts:\n  q_track: 7\n"
    planner, onboard = load_flight_config(write(path, text))
    assert (planner.costs.q_track, onboard.limits.plan_age) == (7.0, 0.2)


def test_settings_may_be_in_a_separate_file(tmp_path: Path):
    expected = OnboardConfig().replace({"rates.replan": 25.0})
    bare = write(tmp_path / "bare.yaml", "rates:\n  replan: 25\n")
    under = write(tmp_path / "under.yaml", "onboard:\n  rates:\n    replan: 25\n")
    assert load_onboard(bare) == load_onboard(under) == load_any(bare)[1] == load_any(under)[1] == expected
    planner_only = write(tmp_path / "planner.yaml", "preset: paper\n")
    assert load_flight_config(planner_only) == (PlannerConfig.preset("paper"), OnboardConfig())


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("onboard:\n  limit:\n", 2, "unknown section 'limit' (did you mean 'limits'?)"),
        ("onboard:\n  limits:\n    plan_ag: 1\n", 3, "unknown setting 'limits.plan_ag' (did you mean"),
        ("onboard:\n  limits:\n    plan_age: 9\n", 3, "limits.plan_age is 9; it must be a number in [0.05, 2] s"),
        ("onboard:\n  limits:\n    plan_age: .nan\n", 3, "limits.plan_age is '.nan'"),
        ("costs:\n  q_track: 1\nonboard:\n   limits:\n", 4, "'limits' is indented by 3 spaces"),
        ("onboard:\n  limits:\n    plan_age: 0.2\n    plan_age: 0.2\n", 4, "limits.plan_age is given twice"),
        ("onboard:\n  limits:\n  limits:\n", 3, "onboard.limits is given twice"),
        ("onboard:\ncosts:\nonboard:\n", 3, "onboard is given twice"),
        ("onboard: {}\n", 1, "put the sections of 'onboard' on lines below it"),
        ("onboard:\n    plan_age: 0.2\n", 2, "'plan_age' is indented by 4 spaces"),
        ("onboard:\n  limits:\n    plan_age:\n", 3, "limits.plan_age has no value"),
        ("onboard:\n  limits: 5\n", 2, "section 'limits' has the value 5"),
        ("onboard:\n  limits:\n    - 5\n", 3, "'- 5' is not understood"),
        ("onboard:\n\tlimits:\n", 2, "there is a tab"),
        ("onboards:\n  limits:\n", 1, "unknown section 'onboards'"),
        ("onboard:\n  limits:\n    plan_ages: 1\n", 3, "'limits.plan_age'?); aero-planner config show lists all."),
        ("onboard:\n  costs:\n    q_track: 1\n", 2, "unknown section 'costs'"),
        ("costs:\n  q_trak: 1\nonboard:\n", 2, "unknown parameter 'costs.q_trak'"),
    ],
)
def test_errors_name_file_line_and_problem(tmp_path: Path, text: str, line: int, problem: str):
    path = write(tmp_path / "wrong.yaml", text)
    with pytest.raises(ValueError) as raised:
        load_flight_config(path)
    message = str(raised.value)
    assert message.startswith(f"{path}, line {line}: ") and problem in message and "\n" not in message


def test_a_node_file_with_planner_parameters_is_refused(tmp_path: Path):
    path = write(tmp_path / "both.yaml", "onboard:\n  limits:\n    plan_age: 0.2\ncosts:\n  q_track: 1\n")
    with pytest.raises(ValueError, match=r"both.yaml, line 4: 'costs' is not one of the node's settings"):
        load_onboard(path)


def test_unreadable_files_name_the_file(tmp_path: Path):
    for load in (load_flight_config, load_onboard, load_any):
        with pytest.raises(ValueError, match=r"absent.yaml can't be read: No such file"):
            load(tmp_path / "absent.yaml")
    (tmp_path / "binary").write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="is not a text file in UTF-8"):
        load_onboard(tmp_path / "binary")


def test_written_files_explain_every_setting():
    text = " ".join(format_onboard(OnboardConfig()).replace("#", " ").split())
    for info in OnboardConfig.parameters():
        assert info.help in text and f"{info.name}: " in text
    assert list(OnboardConfig().to_dict()) == list(OnboardConfig.sections())
