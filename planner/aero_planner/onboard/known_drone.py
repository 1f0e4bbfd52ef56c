"""Facts that the planner of the node knows: the ground, the field of view, and the delay of commands."""

from __future__ import annotations

from aero_planner.config import PlannerConfig
from aero_planner.config.field_of_view import View, mounted_view
from aero_planner.onboard.settings import OnboardConfig


def config_on_drone(planner: PlannerConfig, onboard: OnboardConfig) -> PlannerConfig:
    """Return the planner's configuration as the node flies it.

    The ground always counts as an obstacle, because a Mid-360 does not see what is below the drone. A field of view
    with the default values turns with the sensor as it is mounted. A delay of 0 becomes the lag of the body rates,
    unless the planner models it; latencies are predicted by the node itself.
    """
    space, default, vehicle = planner.unseen_space, PlannerConfig().unseen_space, planner.vehicle
    view = View(space.view_min, space.view_max)
    if view == View(default.view_min, default.view_max):
        view = mounted_view(view, roll=onboard.lidar.mount_roll, pitch=onboard.lidar.mount_pitch)
    return planner.replace({
        "costs.use_ground": True, "unseen_space.view_min": view.lowest, "unseen_space.view_max": view.highest,
        "vehicle.delay": vehicle.delay or vehicle.unmodelled_delay(rate_lag=onboard.response.rate_lag),
    })  # fmt: skip
