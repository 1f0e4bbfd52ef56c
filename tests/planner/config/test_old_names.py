"""Names of the release before: each works, or is ignored, with a notice."""

from pathlib import Path

import pytest

from aero_planner import PlannerConfig
from aero_planner.config import Value
from aero_planner.config.file import load_config
from aero_planner.config.old_names import CHANGED, REMOVED, RENAMED
from tests.planner.config_cases import other_value, write

every_renamed = pytest.mark.parametrize("old", RENAMED)
every_removed = pytest.mark.parametrize("old", REMOVED)


def file_with(path: Path, name: str, value: Value) -> Path:
    section, _, name = name.partition(".")
    return write(path, f"{section}:\n  {name}: {str(value).lower()}\n")


def notices(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def test_no_name_is_both_old_and_new():
    assert not set(RENAMED) & set(REMOVED)
    for old in (*RENAMED, *REMOVED):
        section, _, name = old.partition(".")
        assert all(info.path != old for info in PlannerConfig.parameters()) and section and name
    assert set(RENAMED.values()) <= {info.path for info in PlannerConfig.parameters()}
    assert set(CHANGED) <= set(RENAMED) and len(set(RENAMED.values())) == len(RENAMED)


@every_renamed
def test_a_renamed_parameter_sets_the_new_one(old: str, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    new = RENAMED[old]
    value = other_value(PlannerConfig.find(new))
    expected = PlannerConfig().replace({new: value})
    assert expected != PlannerConfig() and not caplog.records
    section, _, name = old.partition(".")
    path = file_with(tmp_path / "old.yaml", old, value)
    assert PlannerConfig().replace({old: value}) == expected
    assert PlannerConfig.from_dict({section: {name: value}}) == expected
    assert load_config(path) == expected
    which = f", which {CHANGED[old]}" if old in CHANGED else ""
    notice = f"{old} is now {new}{which}; the old name works until the next release."
    assert notices(caplog) == [notice, notice, f"{path}, line 2: {notice}"]
    assert expected.get(old) == value and PlannerConfig.find(old).path == new


@every_removed
@pytest.mark.parametrize("value", [3, True, "off"])
def test_a_removed_parameter_is_ignored_with_its_reason(
    old: str, value: Value, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    section, _, name = old.partition(".")
    path = file_with(tmp_path / "old.yaml", old, value)
    assert PlannerConfig().replace({old: value}) == PlannerConfig()
    assert PlannerConfig.from_dict({section: {name: value}}) == PlannerConfig()
    assert load_config(path) == PlannerConfig()
    notice = f"{old} is ignored: {REMOVED[old]}."
    assert notices(caplog) == [notice, notice, f"{path}, line 2: {notice}"]
    with pytest.raises(ValueError, match=f"{old} was removed: "):
        PlannerConfig.find(old)


def test_one_edge_of_the_view_cannot_be_switched_off_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """The one that switches off both edges says so, and the other one that it does nothing."""
    below = load_config(write(tmp_path / "below.yaml", "partition:\n  continue_below: 0\n  continue_above: 20\n"))
    assert below.unseen_space.continuation == 0.0
    above = load_config(write(tmp_path / "above.yaml", "partition:\n  continue_above: 0\n"))
    assert above == PlannerConfig()
    first, second, third = notices(caplog)
    assert "which holds for both edges of the view" in first
    assert "continue_above is ignored: unseen_space.continuation holds for both" in second
    assert "above.yaml, line 2: partition.continue_above is ignored" in third


@pytest.mark.parametrize("value", ["off", "required", "instead"])
def test_the_stop_proof_has_a_switch_instead(value: str, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = write(tmp_path / "old.yaml", f"candidates:\n  prove_stop: {value}\nstop_proof:\n  prove_stop: false\n")
    assert not load_config(path).stop_proof.prove_stop
    assert "line 2: candidates.prove_stop is ignored: stop_proof.prove_stop switches the stop proof" in caplog.text


def test_an_option_of_a_stage_on_top_of_the_paper_is_not_lost_in_silence(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    config = load_config(write(tmp_path / "old.yaml", "preset: paper\nescape:\n  q_escape: 120\n"))
    assert config.way_out.q_escape == 120.0 and not config.stages.names
    assert notices(caplog)[-1] == "way_out.q_escape has no effect: stages.active does not list way_out."
