"""Smoothness of the commands of flights."""

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightBatch, FlightRules, VehicleModel
from aero_viz.rig.px4_log import count_sign_changes
from aero_viz.rig.rig import PX4_RESPONSE
from aero_viz.scenes import scene
from benchmarks.smoothness import Commands, fly, main, summarize


def test_a_flight_becomes_a_row_of_the_table(capsys: pytest.CaptureFixture[str]):
    options = ["--rows", "random_clutter:5", "--presets", "px4", "--flights", "1", "--time-limit", "0.2"]
    variant = ["--variant", "no jump", "px4", "costs.q_control_jump=0"]
    assert main([*options, *variant, "--ticks-per-plan", "5"]) == 0
    title, _, *header, first, second = capsys.readouterr().out.splitlines()
    assert title.startswith("1 flights per row, a plan every 100 ms, on ") and len(header) == 2
    assert first.startswith("| px4 | random_clutter, 5 m/s | 0 of 1 | ")
    assert second.startswith("| no jump | random_clutter, 5 m/s | 0 of 1 | ")


def test_the_commands_of_every_tick_are_kept():
    rules = FlightRules(ticks_per_plan=5, time_limit=0.2)
    commands = fly(FlightBatch([scene("random_clutter")], config=PlannerConfig.preset("fast-cpu"), rules=rules))
    assert len(commands.heights) >= 10 and commands.flying.all()
    assert len(np.unique(commands.controls[:, 0, 0])) > 5 and len(np.unique(commands.heights)) > 5


def test_px4s_preset_commands_fewer_changes_of_sign():
    """With the lags of a drone with PX4, commands that may jump change their signs more often."""
    smooth = PlannerConfig.preset("px4").replace({"vehicle.speed_limit": 5.0, "sampling.samples": 128})
    free = smooth.replace({"costs.q_control_jump": 0.0, "costs.q_control_rate": 0.5})
    vehicle, rules = VehicleModel.from_config(smooth, **PX4_RESPONSE), FlightRules(time_limit=2.5)
    changes = []
    for config in (smooth, free):
        commands = fly(
            FlightBatch([scene("forest", seed=seed) for seed in (0, 1)], config=config, vehicle=vehicle, rules=rules)
        )
        changes.append(sum(count_sign_changes(commands.controls[:, b, axis]) for b in (0, 1) for axis in (1, 2)))
    assert changes[0] < 0.75 * changes[1], changes


def test_a_change_without_a_value_is_reported():
    with pytest.raises(ValueError, match=r"costs\.q_control_jump is not of the form"):
        main(["--variant", "free", "px4", "costs.q_control_jump"])


def test_ticks_after_the_end_of_a_flight_do_not_count():
    """The roll rate of the first flight changes its sign with every tick and that of the second one never."""
    controls = np.full((10, 2, 4), 1.0)
    controls[:, 0, 1] = np.where(np.arange(10) % 2, 3.0, -3.0)
    controls[6:, 1] = 3.0
    flying = np.ones((10, 2), dtype=bool)
    flying[5:, 0] = False
    heights = np.arange(20.0).reshape(10, 2)
    columns = summarize(Commands(controls, heights, flying), [], PlannerConfig(), period=0.02)
    # 4 changes in 15 ticks; 5 + 4 of 15 roll rates and 4 pitch rates are at the limit of 3 rad/s.
    assert columns == ("0 of 0", "13.3, 0.0, 0.0", "60.0 %, 26.7 %, 0.0 %", "0.50, 13.50 m", "")
