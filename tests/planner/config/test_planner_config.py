import itertools
import math

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_planner.config import ParameterInfo
from aero_planner.config.planner_config import COARSE_COLUMNS, COARSE_ROWS
from aero_planner.config.presets import PRESETS
from aero_planner.registry import names

NUMBERS = [info for info in PlannerConfig.parameters() if info.is_number]

every_parameter = pytest.mark.parametrize("info", PlannerConfig.parameters(), ids=lambda info: info.path)
every_number = pytest.mark.parametrize("info", NUMBERS, ids=lambda info: info.path)


def replace(path: str, value: object) -> PlannerConfig:
    return PlannerConfig().replace({path: value})  # type: ignore[dict-item]


@every_parameter
def test_every_parameter_is_described_and_its_default_is_valid(info: ParameterInfo):
    assert info.help[0].isupper() and info.help.endswith(".") and len(info.help) < 300
    assert info.check(info.default) == info.default
    if info.choices:
        assert info.default in info.choices and len(set(info.choices)) == len(info.choices)
    elif info.is_number:
        assert math.isfinite(info.low) and math.isfinite(info.high) and info.low < info.high
    if info.scale == "log":
        assert info.low > 0
    assert PlannerConfig().get(info.path) == info.default


def test_labels_are_unique_within_a_section():
    infos = PlannerConfig.parameters()
    labels = [(info.section, info.label) for info in infos]
    assert len(labels) == len(set(labels))
    assert all(info.label[0].isupper() and not info.label.endswith(".") and info.group for info in infos)
    assert PlannerConfig.find("costs.q_position").title == "Goal position weight Q_p [1/m]"
    assert PlannerConfig.find("sampling.samples").title == "Samples K"


def test_groups_are_contiguous():
    groups = [(info.section, info.group) for info in PlannerConfig.parameters() if info.live]
    changes = sum(before != after for before, after in itertools.pairwise(groups))
    assert changes + 1 == len(set(groups))


def test_physical_parameters_have_a_unit():
    without = {info.name for info in NUMBERS if not info.unit and isinstance(info.default, float)}
    assert without == {
        "spread", "brake_reach", "temperature", "effective_samples", "correlation", "q_attitude", "q_control",
        "q_control_rate", "penalty", "soft_weight",
    }  # fmt: skip


def test_live_names_are_unique_because_they_share_one_struct():
    live = [info.name for info in PlannerConfig.parameters() if info.live]
    assert len(live) == len(set(live))


def test_parameters_cover_every_section_in_order():
    assert list(dict.fromkeys(info.section for info in PlannerConfig.parameters())) == list(PlannerConfig.sections())
    assert list(PlannerConfig().to_dict()) == list(PlannerConfig.sections())


@every_number
def test_errors_name_parameter_value_and_range(info: ParameterInfo):
    for wrong in (info.high * 2 + 1, info.low - 1, math.nan, math.inf, "5", None, True, [1.0], 1j):
        with pytest.raises(ValueError) as raised:
            replace(info.path, wrong)
        message = str(raised.value)
        assert message.startswith(f"{info.path} is {wrong!r}; it must be a")
        assert f"[{info.low:g}, {info.high:g}]" in message and info.unit in message


@every_number
def test_numbers_are_converted_to_the_type_of_the_parameter(info: ParameterInfo):
    assert not isinstance(info.default, str)
    for number in (float, np.float64, np.array, type(info.default)):
        kept = info.check(number(info.default))
        assert kept == info.default and type(kept) is type(info.default)


@pytest.mark.parametrize("value", [5, np.int64(5), np.float32(5), np.array(5)])
def test_whole_numbers_are_accepted_as_floats(value: object):
    kept = replace("costs.q_track", value).costs.q_track
    assert kept == 5.0 and type(kept) is float


def test_fractions_are_refused_as_whole_numbers():
    with pytest.raises(ValueError, match=r"sampling.samples is 128.5; it must be a whole number in \[1, 4096\]"):
        replace("sampling.samples", 128.5)


@pytest.mark.parametrize("wrong", [1, 0, "true", None, 1.0])
def test_switches_accept_only_booleans(wrong: object):
    with pytest.raises(ValueError, match=r"candidates.previous is .*; it must be true or false"):
        replace("candidates.previous", wrong)
    assert replace("candidates.previous", np.False_).candidates.previous is False


@pytest.mark.parametrize("wrong", ["cubic", 1, None, ["quadratic"], np.array(["quadratic", "cubic"])])
def test_choices_are_listed(wrong: object):
    with pytest.raises(ValueError, match=r"costs.shape is .*; it must be one of quadratic, exponential"):
        replace("costs.shape", wrong)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ("vehicle.thrust_min", "vehicle.thrust_max"),
        ("costs.distance_min", "costs.distance_max"),
        ("partition.range_min", "partition.range_max"),
    ],
)
def test_minima_must_be_below_maxima(low: str, high: str):
    for value in (2.0, 3.0):
        with pytest.raises(ValueError, match=f"{low} is {value}; it must be less than {high}, which is 2.0"):
            PlannerConfig().replace({low: value, high: 2.0})
    assert PlannerConfig().replace({low: 1.9, high: 2.0}).get(low) == 1.9


@pytest.mark.parametrize(
    ("misspelt", "meant"),
    [
        ("costs.q_trak", "costs.q_track"),
        ("cost.q_track", "costs.q_track"),
        ("q_track", "costs.q_track"),
        ("vehicle.penalty", "costs.penalty"),
        ("sampling.sample", "sampling.samples"),
        ("samples", "sampling.samples"),
    ],
)
def test_misspelt_names_get_a_suggestion(misspelt: str, meant: str):
    for call in (PlannerConfig.find, PlannerConfig().get, lambda path: replace(path, 1.0)):
        with pytest.raises(ValueError, match=f"unknown parameter '{misspelt}' .did you mean '{meant}'"):
            call(misspelt)


def test_a_name_like_no_other_gets_no_suggestion_and_the_list():
    with pytest.raises(ValueError, match=r"^unknown parameter 'costs\.zzz'; aero-viz parameters lists all\.$"):
        PlannerConfig.find("costs.zzz")


def test_from_dict_names_the_error():
    with pytest.raises(ValueError, match=r"unknown section 'cost' .did you mean 'costs'.*known: vehicle, partition"):
        PlannerConfig.from_dict({"cost": {}})
    with pytest.raises(ValueError, match="section 'costs' is None; it must hold names and values"):
        PlannerConfig.from_dict({"costs": None})  # type: ignore[dict-item]
    with pytest.raises(ValueError, match="the configuration is None; it must hold sections"):
        PlannerConfig.from_dict(None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"unknown parameter 'costs.q_trak'"):
        PlannerConfig.from_dict({"costs": {"q_trak": 1.0}})
    with pytest.raises(ValueError, match="section 'costs' is 3; it must be a CostConfig"):
        PlannerConfig(costs=3)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", PlannerConfig.presets())
def test_dictionaries_round_trip(name: str):
    config = PlannerConfig.preset(name)
    assert PlannerConfig.from_dict(config.to_dict()) == config
    assert PlannerConfig.presets()[name].endswith(".")


def test_the_parameters_are_few():
    assert len(PlannerConfig.parameters()) <= 70
    assert sum(info.basic for info in PlannerConfig.parameters()) <= 15


@pytest.mark.parametrize("name", PRESETS)
def test_presets_set_only_what_differs_from_the_default(name: str):
    _, changes = PRESETS[name]
    assert set(PlannerConfig().differences(PlannerConfig.preset(name))) == set(changes)


def test_the_preset_for_px4_is_the_default_for_its_lags_and_smooth_commands():
    differences = PlannerConfig().differences(PlannerConfig.preset("px4"))
    assert len(differences) <= 10
    assert {"vehicle.thrust_lag", "vehicle.rate_lag", "costs.q_control_rate"} <= set(differences)


def test_replace_changes_only_what_it_names():
    config = PlannerConfig().replace({"costs.q_track": 7.0, "sampling.steps": 10})
    changed = {info.path for info in PlannerConfig.parameters() if config.get(info.path) != info.default}
    assert changed == {"costs.q_track", "sampling.steps"}
    assert config.structure() != PlannerConfig().structure()
    assert replace("costs.q_track", 7.0).structure() == PlannerConfig().structure()


def test_an_unknown_preset_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"unknown preset 'papr' .did you mean 'paper'.*known: default, paper"):
        PlannerConfig.preset("papr")


def test_paper_preset_is_the_paper():
    paper = PlannerConfig.preset("paper")
    assert paper.kinds == ("anchor",) * 15
    assert paper.horizon == pytest.approx(1.25)
    numbers = {
        "vehicle.mass": 1.0, "vehicle.thrust_min": 0.3, "vehicle.thrust_max": 16.35, "vehicle.rate_xy_max": 3.0,
        "vehicle.rate_z_max": 2.0, "partition.range_max": 10.0, "partition.range_min": 0.0, "partition.fine_cells": 6,
        "anchors.columns": 5, "anchors.rows": 3, "anchors.spacing": 18.0, "anchors.lookahead": 5.0,
        "sampling.samples": 128, "sampling.steps": 25, "sampling.dt": 0.05, "sampling.temperature": 0.1,
        "sampling.effective_samples": 0.0,
        "sampling.variance_thrust": 1.0, "sampling.variance_rate_xy": 1.0, "sampling.variance_rate_z": 0.5,
        "sampling.correlation": 0.0, "costs.q_position": 3.0, "costs.q_velocity": 0.25,
        "costs.q_attitude": 1.0, "costs.q_vnorm": 0.15, "costs.q_track": 15.0, "costs.q_control": 0.5,
        "costs.q_control_rate": 0.5, "costs.penalty": 1e6, "costs.decay": 5.0, "costs.distance_min": 0.4,
        "costs.distance_max": 1.0, "costs.shape": "exponential", "costs.q_speed": 0.0, "costs.q_blocked": 0.0,
        "costs.q_control_jump": 0.0, "costs.q_thrust_jump": 0.0,
    }  # fmt: skip
    assert {path: paper.get(path) for path in numbers} == numbers
    assert (COARSE_ROWS, COARSE_COLUMNS) == (10, 20) and paper.stages.names == ()
    # The option that bounds the look-ahead never binds.
    assert 0.6 * paper.horizon * paper.vehicle.speed_limit > paper.anchors.lookahead


@pytest.mark.parametrize(("limit", "memory"), [(7.0, 3.0), (3.0, 3.0), (2.0, 4.5), (1.0, 9.0), (0.5, 12.0)])
def test_a_slow_drone_remembers_for_longer(limit: float, memory: float):
    config = PlannerConfig().replace({"vehicle.speed_limit": limit})
    assert config.sweep_memory == config.memory.sweep_memory(limit) == memory
    assert config.replace({"memory.memory_distance": 0.0}).sweep_memory == 3.0
    assert config.replace({"stages.active": "way_out"}).sweep_memory == 1.0  # ten sweeps, as in the paper


def test_stages_have_one_form_and_the_order_in_which_they_act():
    config = replace("stages.active", "memory,way_out , memory")
    assert config.stages.active == "way_out, memory" and config.stages.names == ("way_out", "memory")
    assert config == replace("stages.active", "way_out, memory") != PlannerConfig()
    assert replace("stages.active", "").stages.names == ()
    assert PlannerConfig().stages.names == names("stages")


@pytest.mark.parametrize(
    ("wrong", "problem"),
    [
        ("wayout", r"stages\.active has 'wayout' \(did you mean 'way_out'\?\); known: unseen_space, "),
        ("way_out, costs", r"stages\.active has 'costs'.*; known: "),
        ("way_out memory", r"stages\.active has 'way_out memory'"),
        (None, r"stages\.active is None; it must be names separated by commas\."),
    ],
)
def test_wrong_stages_are_named(wrong: object, problem: str):
    with pytest.raises(ValueError, match=problem):
        replace("stages.active", wrong)


def test_a_change_that_an_inactive_stage_ignores_is_noticed(caplog: pytest.LogCaptureFixture):
    paper = PlannerConfig.preset("paper")
    assert paper.replace({"way_out.q_escape": PlannerConfig().way_out.q_escape, "costs.q_track": 3.0}) != paper
    paper.replace({"stages.active": "way_out", "way_out.q_escape": 3.0})
    assert not caplog.records
    paper.replace({"way_out.q_escape": 3.0})
    assert [record.getMessage() for record in caplog.records] == [
        "way_out.q_escape has no effect: stages.active does not list way_out."
    ]
