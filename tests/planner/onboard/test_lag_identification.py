"""Identification of lags from flights of the simulated vehicle."""

import math

import numpy as np
import pytest
import warp as wp

from aero_planner.onboard.lag_identification import identify_lag
from aero_viz.flight.vehicle import Vehicle
from aero_viz.flight.vehicle_model import VehicleModel


@pytest.mark.parametrize("lag", [0.02, 0.07, 0.2])
def test_the_lags_of_the_simulated_vehicle_are_found(lag: float):
    rng = np.random.default_rng(0)
    vehicle = Vehicle(
        VehicleModel(rate_lag=lag, thrust_lag=2.0 * lag), [[0.0, 0.0, 10.0]], [0.0], period=0.01, device="cpu"
    )
    commands: list[np.ndarray] = []
    controls: list[np.ndarray] = []
    active = wp.ones(1, dtype=int, device="cpu")
    command = np.array([9.81, 0.0, 0.0, 0.0])
    for k in range(400):
        if k % 20 == 0:
            command = np.array([9.81, 0.0, 0.0, 0.0]) + rng.normal(size=4)
        controls.append(np.array(vehicle.control.numpy())[0])
        commands.append(command)
        vehicle.fly(wp.array([[command]], dtype=wp.vec4, device="cpu"), active=active)
    times = 5.0 + 0.01 * np.arange(400)
    measured = np.array(controls) * 1.1 + 0.05 + rng.normal(size=(400, 4)) * 0.05
    assert identify_lag(times, np.array(commands)[:, 1], measured[:, 1]) == pytest.approx(lag, rel=0.1, abs=0.005)
    assert identify_lag(times, np.array(commands)[:, 0], measured[:, 0]) == pytest.approx(2.0 * lag, rel=0.1, abs=0.005)


@pytest.mark.parametrize(
    ("times", "commands", "values", "message"),
    [
        (range(12), range(12), range(11), "shapes"),
        (range(12), [0.0] * 12, range(12), "never change"),
        ([0.0] * 12, range(12), range(12), "increasing"),
        (range(12), [math.nan] * 12, range(12), "finite"),
        (range(5), range(5), range(5), "at least 10"),
    ],
)
def test_unusable_logs_are_refused(times, commands, values, message: str):
    with pytest.raises(ValueError, match=message):
        identify_lag(list(times), list(commands), list(values))
