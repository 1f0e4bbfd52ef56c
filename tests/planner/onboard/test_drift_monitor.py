import math

import numpy as np
import pytest

from aero_planner.onboard.cloud_drift import Drift
from aero_planner.onboard.drift_monitor import DriftMonitor


def test_three_measurements_in_three_seconds_count():
    monitor = DriftMonitor()
    for k, shift in enumerate((0.1, 0.2, 0.2)):
        monitor.update(0.5 * k)
        assert math.isnan(monitor.speed)
        monitor.add(0.5 * k, Drift(0.01 * k, np.array([0.0, shift, 0.0])), 0.5)
    monitor.update(1.0)
    assert monitor.speed == pytest.approx(math.sqrt((0.04 + 0.16 + 0.16) / 3))
    assert monitor.angle == pytest.approx(0.01 * math.sqrt(5 / 3))
    monitor.update(3.1)
    assert math.isnan(monitor.speed) and math.isnan(monitor.angle)
