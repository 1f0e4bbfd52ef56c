import math

import numpy as np
import pytest

from aero_planner.onboard.cloud_drift import Drift
from aero_planner.onboard.drift_monitor import DriftMonitor


def add(monitor: DriftMonitor, time: float, shift: float, angle: float = 0.0) -> None:
    monitor.add(time, Drift(angle, np.array([0.0, shift, 0.0])), 0.2)
    monitor.update(time)


def test_it_tells_the_medians_of_three_or_more_measurements_of_a_second():
    monitor = DriftMonitor(1.0)
    for k, shift in enumerate((0.01, 0.2, 0.02)):
        assert math.isnan(monitor.speed) and math.isnan(monitor.angle)
        add(monitor, 0.2 * k, shift, 0.01 * k)
    assert monitor.speed == pytest.approx(0.1) and monitor.angle == pytest.approx(0.01)


def test_a_lasting_error_shows_within_a_second_and_a_single_one_never():
    monitor = DriftMonitor(1.0)
    for k in range(20):
        add(monitor, 0.2 * k, 0.2 if k == 10 else 0.01)
        assert k < 2 or monitor.speed < 0.1
    for k in range(20, 24):
        add(monitor, 0.2 * k, 0.2)
    assert monitor.speed == pytest.approx(1.0)
    for k in range(24, 28):
        add(monitor, 0.2 * k, 0.01)
    assert monitor.speed < 0.1


def test_without_new_measurements_the_last_ones_count_for_three_seconds():
    monitor = DriftMonitor(1.0)
    for k in range(5):
        add(monitor, 0.2 * k, 0.1)
    monitor.update(3.3)
    assert monitor.speed == pytest.approx(0.5)
    monitor.update(3.9)
    assert math.isnan(monitor.speed)
