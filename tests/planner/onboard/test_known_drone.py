"""What the node tells its planner about the drone."""

from aero_planner import PlannerConfig
from aero_planner.onboard.known_drone import config_on_drone
from aero_planner.onboard.settings import OnboardConfig


def test_the_field_of_view_turns_with_the_sensor_and_the_ground_is_avoided():
    inverted = OnboardConfig().replace({"lidar.mount_roll": 180.0})
    for planner in (PlannerConfig(), PlannerConfig.preset("paper")):
        flown = config_on_drone(planner, inverted)
        assert flown.unseen_space.view == "-52 7"
        assert flown.costs.use_ground
    chosen = PlannerConfig().replace({"unseen_space.view": "-30 52"})
    assert config_on_drone(chosen, inverted).unseen_space == chosen.unseen_space


def test_plans_take_effect_after_the_lag_of_the_body_rates():
    onboard = OnboardConfig().replace({"response.rate_lag": 0.08})
    flown = config_on_drone(PlannerConfig(), onboard)
    assert flown == PlannerConfig().replace({"vehicle.delay": 0.08})


def test_a_delay_or_a_lag_of_the_planner_is_kept():
    for chosen in (PlannerConfig.preset("px4"), PlannerConfig().replace({"vehicle.delay": 0.03})):
        assert config_on_drone(chosen, OnboardConfig()) == chosen
