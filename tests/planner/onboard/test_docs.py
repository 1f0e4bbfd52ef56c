"""What docs/onboard.md tells a user to write and to run."""

import re
from pathlib import Path

from aero_planner import PlannerConfig
from aero_planner.onboard.agreement import check_together
from aero_planner.onboard.flight_config import load_flight_config
from aero_planner.onboard.known_drone import config_on_drone
from aero_planner.onboard.px4_parameters import parameter_names
from aero_planner.onboard.settings import OnboardConfig

DOCS = Path(__file__).parents[3] / "docs"
GUIDE = DOCS.joinpath("onboard.md").read_text(encoding="utf-8")


def test_the_flight_configuration_is_valid_and_has_the_preset_of_the_tables(tmp_path: Path):
    (text,) = re.findall(r"```yaml\n(.*?)```", GUIDE, re.DOTALL)
    path = tmp_path / "flight.yaml"
    path.write_text(text)
    planner, onboard = load_flight_config(path)
    check_together(config_on_drone(planner, onboard), onboard)
    (flown,) = re.findall(r"The preset `(\w+)` of that day", GUIDE)
    assert text.startswith(f"preset: {flown}\n")
    assert planner.vehicle.rate_lag == PlannerConfig.preset(flown).vehicle.rate_lag


def test_nothing_is_installed_from_an_index_that_does_not_have_it():
    assert not re.search(r'pip install [^\n]*"?aero-(planner|viz)[\["\s]', GUIDE)


def test_every_parameter_that_preflight_reads_is_explained():
    config = OnboardConfig().replace({"mavlink.goal_senders": "255@autopilot"})
    for name in parameter_names(config):
        assert re.search(rf"^\|[^|]*`{name}`[^|]*\|", GUIDE, re.MULTILINE), name
