"""Facts that the planner of the node knows: the ground, the field of view, and the delay of commands."""

from __future__ import annotations

from aero_planner.config import PlannerConfig
from aero_planner.config.field_of_view import format_views, mounted_view
from aero_planner.onboard.settings import OnboardConfig


def config_on_drone(planner: PlannerConfig, onboard: OnboardConfig) -> PlannerConfig:
    """Return the planner's configuration as the node flies it.

    The ground always counts as an obstacle, because a Mid-360 does not see what is below the drone. A field of view
    with the default values turns with the sensor as it is mounted. A delay of 0 becomes the lag of the body rates,
    unless the planner models it; latencies are predicted by the node itself.
    """
    space, default, vehicle = planner.unseen_space, PlannerConfig().unseen_space, planner.vehicle
    view, mount = space.view, onboard.lidar
    if view == default.view:
        view = format_views(mounted_view(v, roll=mount.mount_roll, pitch=mount.mount_pitch) for v in space.views)
    return planner.replace({
        "costs.use_ground": True, "unseen_space.view": view,
        "vehicle.delay": vehicle.delay or vehicle.unmodelled_delay(rate_lag=onboard.response.rate_lag),
    })  # fmt: skip
