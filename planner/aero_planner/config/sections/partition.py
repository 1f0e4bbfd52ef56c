"""Parameters of the cloud: range, cells, continued surfaces and moving obstacles."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.config.parameter import ParameterSection, live, structural, switch

LONGEST_MEMORY = 12.0
"""Largest time for which sweeps are remembered [s]."""


@dataclass(frozen=True)
class PartitionConfig(ParameterSection, section="partition"):
    """Spherical partition of the point cloud."""

    range_max: float = live(
        10.0,
        "m",
        1.0,
        100.0,
        "Points farther away than this are ignored.",
        label="Maximum range",
        symbol="r_max",
        basic=True,
    )
    range_time: float = live(
        1.0, "s", 0.0, 5.0, "A fast drone sees farther: the maximum range is at least this times the speed limit; 0 as "
        "in the paper.",
        label="Range per speed limit",
    )  # fmt: skip
    range_min: float = live(
        0.1, "m", 0.0, 5.0, "Points closer than this are ignored as returns from the drone itself; 0 as in the paper.",
        label="Minimum range",
    )  # fmt: skip
    cloud_age_max: float = live(
        0.5, "s", 0.05, 10.0, "Age of the cloud above which the drone brakes, if the caller states the age.",
        label="Maximum cloud age",
    )  # fmt: skip
    memory_time: float = live(
        3.0, "s", 0.1, LONGEST_MEMORY, "Sweeps of a simulated flight that are older than this are forgotten. Of those "
        "before the newest ten, one point in five is kept. The onboard node has lidar.older_sweeps instead.",
        label="Memory",
    )  # fmt: skip
    memory_distance: float = live(
        9.0, "m", 0.0, 100.0, "A slow drone remembers for longer, since what leaves its field of view stays near: for "
        "the time in which it flies this distance at its speed limit, at most 12 s.",
        label="Memory of a slow drone",
    )  # fmt: skip
    view_min: float = live(
        -7.0, "deg", -90.0, 90.0, "Lowest elevation that the sensor sees, body frame. What lies below is unknown.",
        label="Lower edge of the view",
    )  # fmt: skip
    view_max: float = live(
        52.0, "deg", -90.0, 90.0, "Highest elevation that the sensor sees, body frame.", label="Upper edge of the view"
    )
    continue_below: float = live(
        20.0, "m", 0.0, 20.0, "Depth to which the surface at the lower edge of the field of view is continued into "
        "empty cells that the sensor does not see; 0 as in the paper.",
        label="Continuation below",
    )  # fmt: skip
    continue_above: float = live(
        20.0, "m", 0.0, 20.0, "Height by which the surface at the upper edge of the field of view is continued into "
        "empty cells that the sensor does not see; 0 as in the paper.",
        label="Continuation above",
    )  # fmt: skip
    continue_before: float = live(
        2.0, "m", 0.0, 1e3, "Surfaces also continue in front of points that are farther by more than this: a point "
        "that was seen from elsewhere does not prove that the way to it is free.",
        label="Continuation before points",
    )  # fmt: skip
    view_age: float = live(
        0.1, "s", 0.0, 1.0, "Time since the sensor has seen all of its field of view. The drone moves meanwhile, so "
        "that surfaces near the edges of the field of view are continued as well; 0 as in the paper.",
        label="Age of the view",
    )  # fmt: skip
    predict: bool = switch(
        True, "Estimate the velocities of obstacles from successive sweeps, and keep clear of their predicted "
        "positions. Off as in the paper.",
        label="Predict motion",
    )  # fmt: skip
    predict_memory: bool = switch(
        True, "Follow moving obstacles for a second behind others, unless that space is seen to be free.",
        label="Remember motion",
    )  # fmt: skip
    predict_wake_speed: float = live(
        2.5, "m/s", 0.0, 50.0, "Speed limit below which points of older sweeps are left out where an obstacle has "
        "moved on since: they are a wall to a slow drone, but keep a fast one away from an obstacle that may turn "
        "back. 0: never.",
        label="Speed limit for forgetting wakes",
    )  # fmt: skip
    predict_range: float = live(
        10.0, "m", 1.0, 100.0, "Obstacles farther away than this are treated as static.",
        label="Range of predicted motion",
    )  # fmt: skip
    predict_speed: float = live(
        0.4, "m/s", 0.05, 10.0, "Obstacles slower than this are treated as static.",
        label="Least speed of predicted motion",
    )  # fmt: skip
    predict_width: float = live(
        1.6, "m", 0.1, 10.0, "Obstacles wider than this are treated as static.",
        label="Width of moving obstacles",
    )  # fmt: skip
    predict_growth: float = live(
        0.1, "m/s", 0.0, 10.0, "Rate at which the predicted radius of a moving obstacle grows.",
        label="Growth of moving obstacles",
    )  # fmt: skip
    fine_cells: int = structural(
        8, 2, 18, "Fine cells along each side of a coarse cell; 6 divide 18 deg into cells of 3 deg, as in the paper.",
        label="Fine cells per coarse cell", symbol="n",
    )  # fmt: skip
    coarse_columns: int = structural(20, 8, 40, "Coarse cells around the horizon; 20 are 18 deg wide each.")
    coarse_rows: int = structural(10, 4, 20, "Coarse cells from straight down to straight up; 10 are 18 deg high each.")
