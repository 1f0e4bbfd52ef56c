import pytest

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig
from aero_planner.config.old_names import REMOVED, RENAMED
from aero_viz.cli.flags import ConfigFlags, Inline
from aero_viz.cli.parser import Command, parse
from aero_viz.cli.renamed_flags import replace_renamed_flags
from aero_viz.errors import UserError
from tests.planner.config_cases import other_value


def load(*arguments: str) -> DroneConfig:
    """Return the configuration of a command line, which may have old names."""
    loaded: list[DroneConfig] = []

    def plan(flags: Inline[ConfigFlags]) -> None:
        loaded.append(flags.load())

    command = Command(lambda: plan, "Plan.")
    parse({"plan": command}, replace_renamed_flags(["plan", *arguments]), prog="test", description="Test.")()
    return loaded[0]


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


@pytest.mark.parametrize("wrong", ["wayout", "None", "way_out memory"])
def test_wrong_names_are_reported(wrong: str):
    with pytest.raises(UserError, match=r"^stages\.active "):
        load("--stages.active", wrong)
