"""Published results of AERO-MPPI, arXiv 2509.17340: means over 50 successful flights per planner and scene.

The paper shows success rates only as plots. According to its text AERO-MPPI stays above 80 % in all scenes up to 7 m/s,
and the other planners "had to reduce their maximum speed limits to achieve 50 successful runs". The flights were
simulated in MARSIM. The paper does not say how smoothness was discretised, so it cannot be compared with ours.
"""

from __future__ import annotations

from typing import NamedTuple


class PublishedRow(NamedTuple):
    """Means over 50 successful flights: speeds [m/s], smoothness [m^2/s^5], length [m], clearances [m]."""

    planner: str
    scene: str
    mean_speed: float
    max_speed: float
    smoothness: float
    length_m: float
    mean_clearance: float
    min_clearance: float


PUBLISHED: tuple[PublishedRow, ...] = (
    PublishedRow("EGO-Planner", "forest", 1.82, 6.37, 278.08, 52.95, 1.66, 0.43),
    PublishedRow("EGO-Planner", "verticals", 1.33, 3.24, 39.02, 52.60, 1.26, 0.35),
    PublishedRow("EGO-Planner", "inclines", 1.04, 2.31, 70.02, 57.88, 1.09, 0.31),
    PublishedRow("Topo-Planner", "forest", 3.27, 6.64, 87.26, 46.46, 1.96, 0.32),
    PublishedRow("Topo-Planner", "verticals", 1.42, 3.02, 49.96, 57.90, 1.18, 0.48),
    PublishedRow("Topo-Planner", "inclines", 1.02, 2.70, 28.51, 59.24, 1.24, 0.49),
    PublishedRow("Fast-Planner", "forest", 2.53, 7.26, 67.26, 47.05, 1.76, 0.65),
    PublishedRow("Fast-Planner", "verticals", 1.21, 3.13, 105.72, 59.33, 1.02, 0.37),
    PublishedRow("Fast-Planner", "inclines", 1.16, 2.32, 18.51, 68.75, 1.07, 0.36),
    PublishedRow("IPC", "forest", 1.84, 3.16, 79.38, 45.72, 1.76, 0.65),
    PublishedRow("IPC", "verticals", 1.29, 3.23, 281.08, 62.86, 0.93, 0.33),
    PublishedRow("IPC", "inclines", 1.33, 3.60, 303.30, 66.09, 0.97, 0.32),
    PublishedRow("AERO-MPPI (paper)", "forest", 5.60, 7.74, 59.38, 45.92, 1.27, 0.51),
    PublishedRow("AERO-MPPI (paper)", "verticals", 3.52, 6.33, 38.20, 51.69, 0.89, 0.39),
    PublishedRow("AERO-MPPI (paper)", "inclines", 5.08, 8.09, 65.30, 48.66, 0.96, 0.33),
)
