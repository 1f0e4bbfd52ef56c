import pytest

from aero_planner import PlannerConfig
from aero_planner.config.old_names import REMOVED, RENAMED
from aero_viz.cli.flags import ConfigFlags, Inline
from aero_viz.cli.parser import Command, parse
from aero_viz.cli.renamed_flags import replace_renamed_flags
from aero_viz.errors import UserError
from tests.planner.config_cases import other_value


def load(*arguments: str) -> PlannerConfig:
    """Return the configuration of a command line, which may have old names."""
    loaded: list[PlannerConfig] = []

    def plan(flags: Inline[ConfigFlags]) -> None:
        loaded.append(flags.load())

    command = Command(lambda: plan, "Plan.")
    parse({"plan": command}, replace_renamed_flags(["plan", *arguments]), prog="test", description="Test.")()
    return loaded[0]


def test_flags_of_renamed_parameters_keep_their_old_spelling(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(PlannerConfig, "renamed", {"costs.old_name": "costs.q_track"})
    monkeypatch.setattr(PlannerConfig, "removed", {"costs.gone": "it had no effect"})
    arguments = ["forest", "--costs.old-name", "3", "--costs.gone", "5", "--costs.gone=5", "--speed", "4"]
    assert replace_renamed_flags(arguments) == ["forest", "--costs.q-track", "3", "--speed", "4"]
    assert replace_renamed_flags(["--costs.old_name=3"]) == ["--costs.q-track=3"]
    assert "costs.old_name is now costs.q_track" in caplog.text
    assert "costs.gone is ignored: it had no effect" in caplog.text


@pytest.mark.parametrize("old", RENAMED)
def test_every_renamed_flag_sets_the_new_parameter(old: str, caplog: pytest.LogCaptureFixture):
    info = PlannerConfig.find(old)
    value = other_value(info)
    assert load(f"--{old}", str(value)) == PlannerConfig().replace({info.path: value}) != PlannerConfig()
    spelled = [f"--{path.replace('_', '-')}={value}" for path in (old, info.path)]
    assert replace_renamed_flags(spelled[:1]) == spelled[1:]
    assert caplog.text.count(f"{old} is now {info.path}") == 2


@pytest.mark.parametrize("old", REMOVED)
def test_every_removed_flag_is_ignored_with_its_reason(old: str, caplog: pytest.LogCaptureFixture):
    assert replace_renamed_flags([f"--{old}", "off", "--speed", "4", f"--{old}=off"]) == ["--speed", "4"]
    assert caplog.text.count(f"{old} is ignored: {REMOVED[old]}.") == 2


@pytest.mark.parametrize(
    ("arguments", "stages"),
    [
        (["--stages.active", "memory, way_out"], ("way_out", "memory")),
        (["--stages.active=way_out"], ("way_out",)),
        (["--stages.active", ""], ()),
        (["--stages.active="], ()),
        ([], PlannerConfig().stages.names),
        (["--config", "paper"], ()),
        (["--config", "paper", "--stages.active", "way_out"], ("way_out",)),
    ],
)
def test_a_list_of_names_may_be_empty(arguments: list[str], stages: tuple[str, ...]):
    assert load(*arguments).stages.names == stages


@pytest.mark.parametrize("wrong", ["wayout", "None", "way_out memory", "way_out,"])
def test_wrong_names_are_reported(wrong: str):
    with pytest.raises(UserError, match=r"^stages\.active "):
        load("--stages.active", wrong)
