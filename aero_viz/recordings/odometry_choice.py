"""The ways to find the motion of a recording, for a command line that does not import the odometry."""

from __future__ import annotations

from typing import Literal

OdometryChoice = Literal["none", "auto", "rko-lio", "kiss-icp"]
