"""Knowledge of the planner of a simulated flight about its drone."""

import dataclasses

import pytest

from aero_planner import PlannerConfig
from aero_viz.flight import FlightSource, VehicleModel
from aero_viz.flight.known_drone import (
    config_for_drone,
    config_for_flight,
    config_for_next_flight,
    config_without_facts,
    facts_after,
)
from aero_viz.scenes import scene
from aero_viz.sensors.models import LIDARS, lidar_model

MID360 = LIDARS["mid360"]


@pytest.mark.parametrize(("preset", "delay"), [("default", 0.09), ("px4", 0.02)])
def test_the_delay_contains_the_lag_of_the_rates_unless_the_planner_models_it(preset: str, delay: float):
    vehicle = VehicleModel(latency=0.02, rate_lag=0.07)
    config = config_for_drone(PlannerConfig.preset(preset), lidar=MID360, vehicle=vehicle)
    assert config.vehicle.delay == delay, "also without the rounding error of the sum"


def test_a_delay_that_was_chosen_stays():
    config = PlannerConfig().replace({"vehicle.delay": 0.2})
    vehicle = VehicleModel(latency=0.02)
    assert config_for_drone(config, lidar=MID360, vehicle=vehicle).vehicle.delay == 0.2


def test_the_field_of_view_turns_with_the_sensor():
    upside_down = dataclasses.replace(MID360, mount_angles=(180.0, 0.0, 0.0))
    part = config_for_drone(PlannerConfig(), lidar=upside_down, vehicle=VehicleModel()).unseen_space
    assert part.view == "-52 7"


def test_the_views_and_the_range_of_cameras_are_known():
    def config_with(lidar: str) -> PlannerConfig:
        return config_for_drone(PlannerConfig(), lidar=lidar_model(lidar), vehicle=VehicleModel())

    def known(view: str, **changes: float) -> PlannerConfig:
        return PlannerConfig().replace({"unseen_space.view": view, "partition.range_max": 6.0} | changes)

    assert config_with("d435@20") == known("-29 29 87 20")
    assert config_with("d435+d435@180") == known("-29 29 87; -29 29 87 180")
    assert config_with("mid360+d435") == known("-7 52; -29 29 87", **{"partition.range_max": 10.0})


def test_the_top_of_the_world_is_the_greatest_height():
    wall, forest = (FlightSource(scene(name, seed=0)).info for name in ("wall", "forest"))
    config = config_for_flight(PlannerConfig(), wall)
    assert wall.world is not None and config.costs.height_max == wall.world.bounds[1, 2] == 2.5
    assert config_for_flight(PlannerConfig.preset("paper"), wall) == PlannerConfig.preset("paper")
    chosen = PlannerConfig().replace({"costs.height_max": 1.5})
    assert config_for_flight(chosen, wall) == chosen
    moved = config_for_next_flight(config, before=wall, after=forest)
    assert moved == config_for_flight(PlannerConfig(), forest)
    assert config_for_next_flight(chosen, before=wall, after=forest) == chosen


@pytest.mark.parametrize("preset", ["default", "paper", "px4"])
def test_a_configuration_without_the_facts_of_its_flight_is_the_preset(preset: str):
    flight = FlightSource(scene("wall", seed=0), lidar=MID360, vehicle=VehicleModel(latency=0.02)).info
    config = PlannerConfig.preset(preset)
    known = config_for_flight(config, flight)
    assert known.unseen_space.view == "-7 52" and known != config
    assert config_without_facts(known, flight) == config
    chosen = known.replace({"costs.height_max": 1.5, "costs.q_track": 9.0})
    assert config_without_facts(chosen, flight) == config.replace({"costs.height_max": 1.5, "costs.q_track": 9.0})


def test_the_top_of_the_world_follows_whether_the_ground_is_used():
    flight = FlightSource(scene("wall", seed=0)).info
    config = config_for_flight(PlannerConfig(), flight)
    off, on = {"costs.use_ground": False}, {"costs.use_ground": True}
    unused = config.replace({**off, **facts_after(off, config=config, flight=flight)})
    assert config_without_facts(unused, flight) == PlannerConfig().replace(off)
    assert unused.replace({**on, **facts_after(on, config=unused, flight=flight)}) == config
    chosen = config.replace({"costs.height_max": 1.5})
    assert facts_after(off, config=chosen, flight=flight) == {}, "a height that was chosen stays"
    unlimited = config.replace({"costs.height_max": 1e5})
    assert facts_after({"costs.q_track": 9.0}, config=unlimited, flight=flight) == {}, "also the default"


def test_the_delay_follows_the_lag_that_the_planner_models():
    vehicle = VehicleModel(latency=0.02, rate_lag=0.07)
    flight = FlightSource(scene("wall", seed=0), vehicle=vehicle).info
    config, changes = config_for_flight(PlannerConfig(), flight), {"vehicle.rate_lag": 0.07}
    assert facts_after(changes, config=config, flight=flight) == {"vehicle.delay": pytest.approx(0.02)}


def test_a_fact_that_returns_to_its_default_is_known_again():
    flight = FlightSource(scene("wall", seed=0)).info
    config = config_for_flight(PlannerConfig(), flight)
    changes, chosen = {"costs.height_max": 1e5}, config.replace({"costs.height_max": 1.5})
    assert facts_after(changes, config=chosen, flight=flight) == {"costs.height_max": 2.5}


def test_heights_that_were_chosen_above_the_world_stay():
    flight = FlightSource(scene("wall", seed=0)).info
    chosen = {"costs.height_max": 9.0, "costs.height_min": 5.0}
    config = config_for_flight(PlannerConfig(), flight).replace(chosen)
    assert config_without_facts(config, flight) == PlannerConfig().replace(chosen)
    assert facts_after({"costs.q_track": 9.0}, config=config, flight=flight) == {}
