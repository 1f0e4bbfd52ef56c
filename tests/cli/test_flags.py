"""Flags that derive from parameters, and the configuration that they describe."""

from typing import Any

import pytest
from command_line import run, terminal_text

from aero_planner import PlannerConfig
from aero_viz.cli.flags import ConfigFlags, DroneFlags, FlightFlags, WorldFlags
from aero_viz.cli.page import flight_opener
from aero_viz.errors import UserError
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.sensors import LIDARS


def flags(config: str = "default", **costs: Any) -> ConfigFlags:
    planner = ConfigFlags().values
    return ConfigFlags(config=config, values=type(planner)(costs=type(planner.costs)(**costs)))


@pytest.mark.parametrize(
    ("config_flags", "use_ground"),
    [
        (flags(), True),
        (flags("fast-cpu"), True),
        (flags(use_ground=False), False),
        (flags("paper"), False),
        (flags("paper", use_ground=True), True),
    ],
)
def test_only_the_paper_preset_ignores_the_ground(config_flags: ConfigFlags, use_ground: bool):
    assert config_flags.load().costs.use_ground == use_ground


@pytest.mark.parametrize("name", [*LIDARS.shipped, "d435+d435@180"])
def test_every_lidar_can_be_chosen(name: str):
    assert FlightFlags().options(PlannerConfig(), lidar=name)["lidar"].name == name


def test_the_help_of_a_pose_names_its_angles(capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "play", "--help")
    assert code == 0 and "--extrinsic X Y Z ROLL PITCH YAW" in terminal_text(text)


def test_the_help_of_a_lidar_flag_names_the_default_of_each_model(capsys: pytest.CaptureFixture[str]):
    code, text, _ = run(capsys, "fly", "--help")
    assert code == 0
    text = terminal_text(text)
    assert (
        "Scan pattern. (default: livox for mid360, even for full-sphere, rings for spinning64, pinhole for d435)"
        in text
    )
    assert "Fraction of the returns that are lost. In [0, 1]. (default: 0.02)" in text


def test_a_file_keeps_the_defaults_that_it_does_not_set(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("costs:\n  q_track: 7\n")
    assert flags(str(file)).load().costs.use_ground


def test_the_stages_and_the_model_have_flags(capsys: pytest.CaptureFixture[str]):
    planner = ConfigFlags().values
    sections = {"stages": type(planner.stages)(active="memory,way_out"), "vehicle": type(planner.vehicle)(model="ctbr")}
    config = ConfigFlags(values=type(planner)(**sections)).load()
    assert config.stages.names == ("way_out", "memory") and config.stages.active == "way_out, memory"
    with pytest.raises(UserError, match=r"stages.active has 'wayout' \(did you mean 'way_out'\?\); known: unseen"):
        ConfigFlags(values=type(planner)(stages=type(planner.stages)(active="wayout"))).load()
    code, text, _ = run(capsys, "fly", "--help")
    assert code == 0 and "--vehicle.model {ctbr,acceleration" in terminal_text(text)
    assert "inf]" not in terminal_text(text), "a text has no bounds"


def test_the_page_plans_with_the_field_of_view_and_the_delay_of_its_flight():
    def config_with(flags: FlightFlags, lidar: str) -> PlannerConfig:
        opener = flight_opener("wall", WorldFlags(), flags, PlannerConfig(), lidar=lidar, device="cpu")
        return config_for_flight(PlannerConfig(), opener("wall", seed=0).info)

    config = config_with(FlightFlags(drone=DroneFlags(latency=0.05)), "full-sphere")
    assert (config.unseen_space.view, config.vehicle.delay) == ("-90 90", 0.05)
    top = {"costs.height_max": config.costs.height_max}
    assert config_with(FlightFlags(), "mid360") == PlannerConfig().replace(top)
