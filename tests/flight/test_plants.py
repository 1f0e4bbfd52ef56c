"""What flies, by the vehicle model of the planner."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Planner, PlannerConfig
from aero_planner.quaternions import rotate
from aero_viz.flight import FlightBatch, FlightRules, FlightSource, VehicleModel
from aero_viz.flight.vehicle import Vehicle
from aero_viz.scenes import scene

QUICK = PlannerConfig.preset("fast-cpu").replace({"vehicle.model": "acceleration", "vehicle.speed_limit": 3.0})


def respond(setpoint: tuple[float, ...], ticks: int, **changes: Any) -> tuple[np.ndarray, Vehicle]:
    """Return the acceleration after each tick of 5 ms under one setpoint, [ticks, 3], and the vehicle."""
    model = VehicleModel(**changes).commanded_by(QUICK)
    vehicle = Vehicle(model, np.zeros((1, 3)), [0.0], period=0.005, device="cpu")
    commands, accelerations = wp.array([[setpoint]], dtype=wp.vec4), []
    for _ in range(ticks):
        vehicle.fly(commands, active=wp.ones(1, dtype=int))
        accelerations.append(vehicle.acceleration.numpy()[0].copy())
    return np.array(accelerations, dtype=float), vehicle


def test_an_autopilot_hovers_without_a_setpoint_of_acceleration():
    accelerations, vehicle = respond((0.0, 0.0, 0.0, 0.0), 100)
    np.testing.assert_allclose(accelerations, 0.0, atol=1e-5)
    np.testing.assert_allclose(vehicle.quaternion.numpy()[0], [1.0, 0.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("setpoint", [(2.0, -1.0, 0.0), (-1.0, 3.0, 1.5), (0.0, 1.0, -3.0)])
def test_a_setpoint_is_reached_in_the_end(setpoint: tuple[float, float, float]):
    accelerations, vehicle = respond((*setpoint, 0.0), 400)
    np.testing.assert_allclose(accelerations[-1], setpoint, atol=0.01)
    force = np.add(setpoint, [0.0, 0.0, 9.81])
    axis = rotate(vehicle.quaternion.numpy()[0].astype(float), np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(axis, force / np.linalg.norm(force), atol=1e-3)


@pytest.mark.parametrize("gain", [8.0, 12.0])
def test_a_small_setpoint_is_followed_with_the_time_constant_of_the_attitude_control(gain: float):
    accelerations, _ = respond((0.5, 0.0, 0.0, 0.0), 100, attitude_gain=gain)
    time = 0.005 * np.arange(1, 101)
    np.testing.assert_allclose(accelerations[:, 0], 0.5 * (1.0 - np.exp(-gain * time)), atol=0.02)


def test_a_large_setpoint_is_followed_at_the_largest_rate():
    _, vehicle = respond((9.0, 0.0, 0.0, 0.0), 20)
    assert vehicle.control.numpy()[0, 2] == pytest.approx(3.0)  # pitch, at its bound
    angle = 2.0 * np.arccos(vehicle.quaternion.numpy()[0, 0])
    assert angle == pytest.approx(3.0 * 20 * 0.005, rel=1e-3)


def test_lags_of_thrust_and_rates_delay_the_acceleration_further():
    prompt, late = (
        respond((2.0, 0.0, 1.0, 0.0), 15, **lags)[0] for lags in ({}, {"thrust_lag": 0.04, "rate_lag": 0.04})
    )
    assert (late[4:, 0] < 0.95 * prompt[4:, 0]).all() and (late[:8, 2] < 0.9 * prompt[:8, 2]).all()


def test_a_yaw_rate_turns_about_the_vertical_also_when_tilted():
    _, vehicle = respond((2.0, 0.0, 0.0, 0.8), 200)
    nose = rotate(vehicle.quaternion.numpy()[0].astype(float), np.array([1.0, 0.0, 0.0]))
    assert np.arctan2(nose[1], nose[0]) == pytest.approx(0.8, abs=0.05)
    np.testing.assert_allclose(vehicle.acceleration.numpy()[0], [2.0, 0.0, 0.0], atol=0.2)


def test_the_planner_knows_how_an_autopilot_follows():
    """Where a plan is flown without a new one for half a second, the drone is where the plan says."""
    rules = FlightRules(ticks_per_plan=25, time_limit=10.0)
    config = QUICK.replace({"sampling.dt": 0.05})
    batch = FlightBatch([scene("forest", seed=seed, count=5) for seed in (0, 1)], config=config, rules=rules)
    errors, lengths = [], []
    for _ in range(8):
        start = batch.simulator.vehicle.position.numpy().copy()
        for _ in range(25):
            batch.step()
        plan, position = batch.planner.outputs, batch.simulator.vehicle.position.numpy()
        for b, row in enumerate(plan.flown.numpy()):
            errors.append(np.linalg.norm(plan.positions.numpy()[b, row, 10] - position[b]))
            lengths.append(np.linalg.norm(position[b] - start[b]))
    assert np.mean(errors) < 0.08 * np.mean(lengths), (np.mean(errors), np.mean(lengths))


def test_a_drone_that_is_commanded_by_its_acceleration_arrives():
    worlds = [scene("random_clutter", seed=seed) for seed in (1, 2)]
    results = FlightBatch(worlds, config=QUICK, rules=FlightRules(ticks_per_plan=5)).run()
    assert [result.reason for result in results] == ["arrived"] * 2


def test_a_flight_obeys_the_plans_whatever_their_model_is():
    source = FlightSource(scene("forest", seed=0, count=5), rules=FlightRules(ticks_per_plan=5))
    for name in ("ctbr", "acceleration", "ctbr"):
        planner = Planner(QUICK.replace({"vehicle.model": name}), threads=1)
        for _ in range(10):
            plan = source.observe().plan_with(planner)
            assert plan.model == name
            source.advance(plan)
        assert source.simulator.vehicle.model.model == name and source.outcome is None
    assert source.observe().actual_state.position[0] > 2.0  # type: ignore[index]


OWN = """
from dataclasses import dataclass
from typing import Any
import warp as wp
from aero_planner import registry
from aero_planner.models import VehicleModel
from aero_planner.parameters import ParameterSection, live

@dataclass(frozen=True)
class Cart(ParameterSection, section="cart"):
    gain: float = live(2.0, "", 0.0, 10.0, "Velocity per command.")

@wp.struct
class Constants:
    dt: float
    gain: float
    wind: wp.vec3

@wp.func
def clamp(u: wp.vec4, c: Any) -> wp.vec4:
    return wp.vec4(wp.min(u[0], 1.0), u[1], 0.0, 0.0)

@wp.func
def noise(c: Any) -> wp.vec4:
    return wp.vec4(1.0, 1.0, 0.0, 0.0)

@wp.func
def constants(disturbance: wp.vec3, drag: float, dt: float, c: Any) -> Constants:
    k = Constants()
    k.dt = dt
    k.gain = c.gain
    return k

@wp.func
def step(p: wp.vec3, v: wp.vec3, q: wp.vec4, acting: wp.vec4, u: wp.vec4, k: Constants):
    v = k.gain * wp.vec3(u[0], u[1], 0.0)
    return p + k.dt * v, v, q, u

@wp.func
def acceleration(v: wp.vec3, q: wp.vec4, acting: wp.vec4, k: Constants) -> wp.vec3:
    return wp.vec3(0.0, 0.0, k.gain)

@wp.func
def follow(p: wp.vec3, v: wp.vec3, q: wp.vec4, a: wp.vec4, guide: Any, t: float, rate: float, k: Constants, c: Any):
    return wp.vec4(0.0, 0.0, 0.0, 0.0)

controls = (("x", ""),) * 4
registry.add("models", "cart", VehicleModel("cart", "Cart", controls, clamp, noise, constants, step, acceleration,
                                            follow, parameters=Cart))
import numpy as np
from aero_planner import PlannerConfig
from aero_viz.flight import VehicleModel as Drone
from aero_viz.flight.vehicle import Vehicle
config = PlannerConfig().replace({"vehicle.model": "cart", "cart.gain": 3.0})
vehicle = Vehicle(Drone.from_config(config, latency=0.02), np.zeros((1, 3)), [0.0], period=0.02, device="cpu")
for _ in range(51):  # the first one waits for the latency
    vehicle.fly(wp.array([[(9.0, -0.5, 0.0, 0.0)]], dtype=wp.vec4), active=wp.ones(1, dtype=int))
print(vehicle.position.numpy()[0].tolist(), vehicle.acceleration.numpy()[0].tolist())
"""


def test_the_model_of_a_user_moves_by_its_own_step_and_parameters(tmp_path: Path):
    script = tmp_path / "cart.py"  # Warp reads the source of functions
    script.write_text(OWN)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    result = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, env=environment, timeout=600)
    assert result.returncode == 0, result.stderr
    numbers = result.stdout.splitlines()[-1].replace("[", "").replace("]", "").replace(",", " ").split()
    assert [float(number) for number in numbers] == pytest.approx([3.0, -1.5, 0.0, 0.0, 0.0, 3.0], abs=1e-4)
