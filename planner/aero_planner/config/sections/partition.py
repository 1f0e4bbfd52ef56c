"""Parameters of the cloud: range, age and cells."""

from __future__ import annotations

from dataclasses import dataclass

from aero_planner.parameters import ParameterSection, live, structural


@dataclass(frozen=True)
class PartitionConfig(ParameterSection, section="partition"):
    """Spherical partition of the point cloud."""

    range_max: float = live(
        10.0,
        "m",
        1.0,
        100.0,
        "Points farther away than this are ignored, or than twice the look-ahead of a fast drone, if that is more.",
        label="Maximum range",
        symbol="r_max",
        basic=True,
    )
    range_min: float = live(
        0.1, "m", 0.0, 5.0, "Points closer than this are ignored as returns from the drone itself; 0 as in the paper.",
        label="Minimum range",
    )  # fmt: skip
    cloud_age_max: float = live(
        0.5, "s", 0.05, 10.0, "Age of the cloud above which the drone brakes, if the caller states the age.",
        label="Maximum cloud age",
    )  # fmt: skip
    fine_cells: int = structural(
        8, 2, 18, "Fine cells along each side of a coarse cell; 6 divide 18 deg into cells of 3 deg, as in the paper.",
        label="Fine cells per coarse cell", symbol="n",
    )  # fmt: skip
