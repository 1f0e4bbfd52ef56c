import itertools
import os
from pathlib import Path

import pytest
import yaml
from hypothesis import HealthCheck, given, settings

from aero_planner import PlannerConfig
from aero_planner.config.file import config_from_name, format_changes, format_config, load_config, save_config
from tests.planner.config_cases import configs, write


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(configs(PlannerConfig))
def test_saved_files_round_trip_and_read_the_same_with_any_yaml_reader(tmp_path: Path, config: PlannerConfig):
    path = tmp_path / "config.yaml"
    save_config(config, path)
    assert load_config(path) == config
    assert yaml.safe_load(path.read_text()) == config.to_dict()
    assert os.listdir(tmp_path) == ["config.yaml"]


@pytest.mark.parametrize(
    ("text", "stages"),
    [
        ("way_out", ("way_out",)),
        ("memory, way_out  # both", ("way_out", "memory")),
        ("'memory,way_out'", ("way_out", "memory")),
        ("''", ()),
        ("way_out,", ("way_out",)),
        ("", ()),
        (" # none", ()),
    ],
)
def test_a_list_of_names_may_be_empty(tmp_path: Path, text: str, stages: tuple[str, ...]):
    config = load_config(write(tmp_path / "a.yaml", f"stages:\n  active: {text}\n"))
    assert config.stages.names == stages
    for form in (format_config(config), format_changes(config)):
        assert load_config(write(tmp_path / "b.yaml", form)) == config


@pytest.mark.parametrize("value", [1e-5, 1e-300, 5e-324, 0.1 + 0.2, 1e3, 123.456789012345])
def test_floats_round_trip_exactly(tmp_path: Path, value: float):
    path = tmp_path / "config.yaml"
    save_config(PlannerConfig().replace({"costs.q_track": value}), path)
    assert load_config(path).costs.q_track == value
    assert yaml.safe_load(path.read_text())["costs"]["q_track"] == value


def test_saved_files_explain_every_parameter():
    text = " ".join(format_config(PlannerConfig()).replace("#", " ").split())
    for info in PlannerConfig.parameters():
        assert info.help in text and f"{info.name}: " in text
    assert "[0 to 1000 1/m]" in text


def test_a_file_builds_on_a_preset(tmp_path: Path):
    text = "\ufeff# mine\r\npreset: paper\r\n\r\ncosts:  # weights\r\n  q_track: 7   # less\r\n  shape: 'quadratic'"
    config = load_config(write(tmp_path / "a.yaml", text))
    changes = {"costs.q_track": 7.0, "costs.shape": "quadratic"}
    assert config == PlannerConfig.preset("paper").replace(changes)
    assert load_config(write(tmp_path / "empty.yaml", "")) == PlannerConfig()


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("5", 5.0),
        ("+5.", 5.0),
        (".5", 0.5),
        ("5e1", 50.0),
        ("1e2", 100.0),
        ("1E-3", 0.001),
        ("5.0E+1", 50.0),
        ("5 # five", 5.0),
        ("0.0", 0.0),
    ],
)
def test_numbers_may_be_written_in_any_common_form(tmp_path: Path, text: str, value: float):
    assert load_config(write(tmp_path / "a.yaml", f"costs:\n  q_track: {text}\n")).costs.q_track == value


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("cost:\n", 1, "unknown section 'cost' (did you mean 'costs'?)"),
        ("costs:\n  q_trak: 1\n", 2, "unknown parameter 'costs.q_trak' (did you mean 'costs.q_track'?)"),
        ("vehicle:\n  q_track: 1\n", 2, "did you mean 'costs.q_track'?"),
        ("costs:\n\n  q_track: 1e9\n", 3, "costs.q_track is 1000000000.0; it must be a number in [0, 1000] 1/m"),
        ("costs:\n  q_track: '5'\n", 2, "costs.q_track is '5'; it must be a number"),
        ("costs:\n  q_track: .nan\n", 2, "costs.q_track is '.nan'; it must be a number"),
        ("costs:\n  q_track: 010\n", 2, "costs.q_track is '010'; it must be a number"),
        ("costs:\n  q_track: 1_0\n", 2, "costs.q_track is '1_0'; it must be a number"),
        (f"costs:\n  q_track: {'9' * 5000}\n", 2, "costs.q_track is inf; it must be a number in [0, 1000]"),
        (f"sampling:\n  samples: {'9' * 350}\n", 2, "sampling.samples is inf; it must be a whole number"),
        ("costs:\n  q_track: e5\n", 2, "costs.q_track is 'e5'; it must be a number"),
        ("costs:\n  q_track: [5]\n", 2, "costs.q_track is '[5]'; it must be a number"),
        ("candidates:\n  previous: yes\n", 2, "candidates.previous is 'yes'; it must be true or false"),
        ("costs:\n  q_track: 1\n  q_track: 1\n", 3, "costs.q_track is given twice"),
        ("costs:\n  q_track: 1\ncosts:\n", 3, "costs is given twice"),
        ("preset: paper\npreset: paper\n", 2, "preset is given twice"),
        ("preset: papr\n", 1, "unknown preset 'papr' (did you mean 'paper'?)"),
        ("preset:\n", 1, "preset has no value"),
        ("costs:\n\tq_track: 1\n", 2, "there is a tab"),
        ("costs:\n   q_track: 1\n", 2, "'q_track' is indented by 3 spaces"),
        ("  q_track: 1\n", 1, "'q_track' belongs to no section"),
        ("costs:\npreset: paper\n  q_track: 1\n", 3, "'q_track: 1' is not understood"),
        ("costs:\n  q_track:\n", 2, "costs.q_track has no value"),
        ("costs:\n  q_track: # nothing\n", 2, "costs.q_track has no value"),
        ("costs: {q_track: 1}\n", 1, "section 'costs' has the value '{q_track: 1}'"),
        ("costs:\n  shape: 'quadratic\n", 2, "has no matching quote"),
        ("costs:\n  - q_track\n", 2, "'- q_track' is not understood"),
        ("costs:\n  q_track:1\n", 2, "'q_track:1' is not understood"),
        ("---\n", 1, "'---' is not understood"),
        ("costs:\n  q_track: 1\n---\ncosts:\n", 3, "'---' is not understood"),
        ("costs:\n  q_track: &a 1\n", 2, "anchors, aliases and tags are not supported"),
        ("costs: &a\n  q_track: 1\nvehicle: *a\n", 1, "anchors, aliases and tags are not supported"),
        ("costs:\n  q_track: *a\n", 2, "anchors, aliases and tags are not supported"),
        ("costs:\n  q_track: !!float 1\n", 2, "anchors, aliases and tags are not supported"),
        ("costs:\n  q_track: !!python/object/apply:os.getpid []\n", 2, "tags are not supported"),
        ("costs:\n  q_track: " + "[" * 100_000 + "\n", 2, "it is nested too deeply"),
        ("costs:\n  q_track: [1,\n    2]\n", 2, "costs.q_track is '[1, 2]'"),
        ("costs:\n  q_track:\n    5\n", 3, "'5' is not understood"),
        ("costs:\n  q_track:\n    value: 5\n", 2, "costs.q_track has entries below it"),
        ("preset:\n  paper: 1\n", 1, "preset has entries below it"),
        ("costs:\n  q_track: 1\n   q_velocity: 1\n", 3, "'q_velocity: 1' is not understood"),
        ("costs:\n  q_track: 1\n  ? [a]\n  : 1\n", 3, "'? [a]' is not understood"),
        ("costs:\n  q_track: @5\n", 2, "'q_track: @5' is not understood"),
        ("costs:\n  q_track: 5 \x00\n", 2, "there is the character '\\x00'"),
        ("costs:\n  q_track: off\n", 2, "costs.q_track is 'off'; it must be a number"),
        ("costs:\n  q_track: 0x10\n", 2, "costs.q_track is '0x10'; it must be a number"),
        ("costs:\n  q_track: 1:30\n", 2, "costs.q_track is '1:30'; it must be a number"),
        ("candidates:\n  previous: 'true'\n", 2, "candidates.previous is 'true'; it must be true or false"),
        ("stages:\n  active: [way_out]\n", 2, "stages.active has '[way_out]' (did you mean 'way_out'?); known: "),
        ("stages:\n\n  active: off\n", 3, "stages.active has 'off'"),
        ("stages:\n  active: wayout\n", 2, "stages.active has 'wayout' (did you mean 'way_out'?)"),
        ("escape:\n  q_escap: 1\n", 2, "unknown parameter 'escape.q_escap' (did you mean 'way_out.q_escape'?)"),
        ("5\n", 1, "'5' is not understood"),
        ("- costs\n", 1, "'- costs' is not understood"),
    ],
)
def test_errors_name_file_line_and_problem(tmp_path: Path, text: str, line: int, problem: str):
    path = write(tmp_path / "wrong.yaml", text)
    with pytest.raises(ValueError) as raised:
        load_config(path)
    message = str(raised.value)
    assert message.startswith(f"{path}, line {line}: ")
    assert problem in message and "\n" not in message


def test_contradictions_name_the_file_and_a_line(tmp_path: Path):
    path = write(tmp_path / "wrong.yaml", "costs:\n  distance_min: 0.9\n")
    with pytest.raises(ValueError, match=r"wrong.yaml, line 2: costs.distance_min is 0.9; it must be less than"):
        load_config(path)


def test_unreadable_files_name_the_file(tmp_path: Path):
    with pytest.raises(ValueError, match=r"absent.yaml can't be read: No such file"):
        load_config(tmp_path / "absent.yaml")
    with pytest.raises(ValueError, match="can't be read: Is a directory"):
        load_config(tmp_path)
    (tmp_path / "binary").write_bytes(b"costs:\n\xff\xfe")
    with pytest.raises(ValueError, match=r"binary is not a text file in UTF-8 \(byte 7\)"):
        load_config(tmp_path / "binary")


def test_large_files_are_refused_without_reading_them_whole(tmp_path: Path):
    path = write(tmp_path / "large.yaml", "# comment\n" * 30_000)
    with pytest.raises(ValueError, match=rf"{path} is larger than 256 KiB; give a configuration file\."):
        load_config(path)


def test_a_bomb_of_aliases_is_refused(tmp_path: Path):
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in itertools.pairwise("abcdefghi")]
    with pytest.raises(ValueError, match=r"line 1: .* \(anchors, aliases and tags are not supported\)"):
        load_config(write(tmp_path / "bomb.yaml", "\n".join(lines)))


def test_a_failed_save_leaves_no_temporary_file(tmp_path: Path):
    with pytest.raises(ValueError, match=r"absent/config.yaml can't be written: No such file"):
        save_config(PlannerConfig(), tmp_path / "absent" / "config.yaml")
    (tmp_path / "folder").mkdir()
    with pytest.raises(ValueError, match=r"folder can't be written"):
        save_config(PlannerConfig(), tmp_path / "folder")
    assert os.listdir(tmp_path) == ["folder"]


def test_saving_through_a_symbolic_link_keeps_the_link(tmp_path: Path):
    target, link = tmp_path / "target.yaml", tmp_path / "link.yaml"
    save_config(PlannerConfig(), target)
    link.symlink_to(target)
    save_config(PlannerConfig.preset("paper"), link)
    assert link.is_symlink() and load_config(target) == PlannerConfig.preset("paper")


def test_names_are_presets_or_files(tmp_path: Path):
    assert config_from_name("paper") == PlannerConfig.preset("paper")
    path = tmp_path / "mine.yaml"
    save_config(PlannerConfig.preset("fast-cpu"), path)
    assert config_from_name(path) == config_from_name(str(path)) == PlannerConfig.preset("fast-cpu")
    with pytest.raises(ValueError, match=r"'papr' is neither a preset .did you mean 'paper'.*presets: default, paper"):
        config_from_name("papr")
