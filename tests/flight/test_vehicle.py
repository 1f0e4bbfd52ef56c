"""The vehicle compared with closed forms and a float64 reference written from the equations."""

import numpy as np
import pytest
import warp as wp

from aero_planner import PlannerConfig
from aero_viz.flight.vehicle import Vehicle
from aero_viz.flight.vehicle_model import VehicleModel

G = 9.81
HOVER = (G, 0.0, 0.0, 0.0)


def run(model: VehicleModel, commands, *, heading=0.0, velocity=(0.0, 0.0, 0.0), period=0.02):
    """Fly one command per tick; return p, v, q and the acceleration after each tick, float64."""
    vehicle = Vehicle(model, np.zeros((1, 3)), [heading], period=period, device="cpu")
    vehicle.velocity.assign(np.array([velocity], dtype=np.float32))
    flying = wp.ones(1, dtype=int)
    states = []
    for command in commands:
        vehicle.fly(wp.array([[command]], dtype=wp.vec4), active=flying)
        arrays = (vehicle.position, vehicle.velocity, vehicle.quaternion, vehicle.acceleration)
        states.append([array.numpy()[0].astype(float) for array in arrays])
    return [np.array(column) for column in zip(*states, strict=True)]


def reference(command, position, velocity, quaternion, *, step, steps, mass=1.0, drag=0.0):
    """RK4 of dp = v, dv = R(q) [0, 0, F] / m + g - k v, dq = 1/2 q (x) [0, omega]."""

    def product(a, b):
        w, u = a[0], a[1:]
        return np.array([w * b[0] - u @ b[1:], *(w * b[1:] + b[0] * u + np.cross(u, b[1:]))])

    def rate(x):
        v, q = x[3:6], x[6:]
        thrust = product(product(q, np.array([0.0, 0.0, 0.0, command[0]])), q * [1, -1, -1, -1])[1:]
        spin = 0.5 * product(q, np.array([0.0, *command[1:]]))
        return np.concatenate([v, thrust / mass - [0, 0, G] - drag * v, spin])

    x = np.concatenate([position, velocity, quaternion])
    for _ in range(steps):
        k1 = rate(x)
        k2 = rate(x + 0.5 * step * k1)
        k3 = rate(x + 0.5 * step * k2)
        k4 = rate(x + step * k3)
        x = x + step / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)
        x[6:] /= np.linalg.norm(x[6:])
    return x[:3], x[3:6], x[6:]


def test_hover_stays():
    p, v, q, a = run(VehicleModel(), [HOVER] * 500)
    np.testing.assert_allclose(p, 0.0, atol=1e-6)
    np.testing.assert_allclose(v, 0.0, atol=1e-6)
    np.testing.assert_allclose(a, 0.0, atol=1e-6)
    np.testing.assert_allclose(q, np.tile([1.0, 0, 0, 0], (500, 1)), atol=1e-7)


def test_free_fall():
    p, v, _, a = run(VehicleModel(thrust_min=0.0), [(0.0, 0.0, 0.0, 0.0)] * 100)
    t = 0.02 * np.arange(1, 101)
    np.testing.assert_allclose(p[:, 2], -0.5 * G * t**2, rtol=1e-5)
    np.testing.assert_allclose(v[:, 2], -G * t, rtol=1e-5)
    np.testing.assert_allclose(a, np.tile([0, 0, -G], (100, 1)), rtol=1e-6)
    # Energy is conserved: v^2 / 2 + g z = 0.
    np.testing.assert_allclose(0.5 * v[:, 2] ** 2, -G * p[:, 2], rtol=1e-5)


def test_constant_yaw_rate_turns_in_place():
    p, _, q, _ = run(VehicleModel(), [(G, 0.0, 0.0, 1.5)] * 100, heading=0.3)
    yaw = 0.3 + 1.5 * 0.02 * np.arange(1, 101)
    np.testing.assert_allclose(q[:, 0], np.cos(0.5 * yaw), atol=1e-5)
    np.testing.assert_allclose(q[:, 3], np.sin(0.5 * yaw), atol=1e-5)
    np.testing.assert_allclose(p, 0.0, atol=1e-5)


def test_constant_pitch_rate():
    # The thrust axis turns by w t toward x: v_x = F / (m w) (1 - cos w t), v_z = F / (m w) sin w t - g t.
    thrust, w, mass = 12.0, 1.2, 1.3
    _, v, _, a = run(VehicleModel(mass=mass), [(thrust, 0.0, w, 0.0)] * 60)
    t = 0.02 * np.arange(1, 61)
    np.testing.assert_allclose(v[:, 0], thrust / (mass * w) * (1 - np.cos(w * t)), atol=2e-5)
    np.testing.assert_allclose(v[:, 2], thrust / (mass * w) * np.sin(w * t) - G * t, atol=2e-5)
    np.testing.assert_allclose(a[:, 0], thrust / mass * np.sin(w * t), atol=2e-5)


def test_thrust_does_the_work_that_the_energy_gains():
    # d/dt (v^2 / 2 + g z) = v . F / m, here with a constant tilt reached by rolling first.
    p, v, q, _ = run(VehicleModel(), [(G, 1.0, 0.0, 0.0)] * 20 + [(11.0, 0.0, 0.0, 0.0)] * 60)
    p, v, q = p[19:], v[19:], q[19:]
    axis = np.array([0.0, -np.sin(0.4), np.cos(0.4)])
    gained = 0.5 * np.sum(v[-1] ** 2 - v[0] ** 2) + G * (p[-1, 2] - p[0, 2])
    assert gained == pytest.approx(11.0 * axis @ (p[-1] - p[0]), rel=1e-4)


def test_drag_leads_to_the_terminal_speed():
    _, v, _, _ = run(VehicleModel(thrust_min=0.0, drag=0.5), [(0.0, 0.0, 0.0, 0.0)] * 300)
    t = 0.02 * np.arange(1, 301)
    np.testing.assert_allclose(v[:, 2], -G / 0.5 * (1 - np.exp(-0.5 * t)), rtol=1e-5)


def test_lags_are_first_order():
    model = VehicleModel(thrust_lag=0.1, rate_lag=0.05)
    vehicle = Vehicle(model, np.zeros((1, 3)), [0.0], period=0.02, device="cpu")
    for k in range(1, 11):
        vehicle.fly(wp.array([[(14.0, 1.0, -1.0, 0.5)]], dtype=wp.vec4), active=wp.ones(1, dtype=int))
        control = vehicle.control.numpy()[0]
        assert control[0] == pytest.approx(G + (14.0 - G) * (1 - np.exp(-0.02 * k / 0.1)), rel=1e-5)
        np.testing.assert_allclose(control[1:], np.array([1.0, -1.0, 0.5]) * (1 - np.exp(-0.02 * k / 0.05)), rtol=1e-5)


@pytest.mark.parametrize(("latency", "late_steps"), [(0.0, 0), (0.01, 2), (0.02, 4), (0.034, 7)])
def test_latency_delays_commands_by_whole_steps(latency, late_steps):
    # Thrust steps from g to 14 N at time 0 and on to 12 N after 20 ms; steps of 5 ms.
    late, prompt = VehicleModel(latency=latency), VehicleModel()
    vehicle = Vehicle(late, np.zeros((1, 3)), [0.0], period=0.02, device="cpu")
    heights = []
    for thrust in (14.0, 12.0, 12.0, 12.0):
        vehicle.fly(wp.array([[(thrust, 0.0, 0.0, 0.0)]], dtype=wp.vec4), active=wp.ones(1, dtype=int))
        heights += vehicle.trail.numpy()[0, :, 2].tolist()
    thrusts = [G] * late_steps + [14.0] * 4 + [12.0] * 12
    expected = run(prompt, [(t, 0.0, 0.0, 0.0) for t in thrusts[:16]], period=0.005)[0][:, 2]
    np.testing.assert_allclose(heights, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("phase", "thrust"), [(0.0, 8.0), (0.4, 9.6), (1.0, 12.0), (1.5, 11.0), (2.0, 10.0), (7.3, 10.0)]
)
def test_controls_are_interpolated_between_those_of_the_plan(phase, thrust):
    vehicle = Vehicle(VehicleModel(), np.zeros((1, 3)), [0.0], period=0.02, device="cpu")
    plan = wp.array([[(f, 0.1 * f, 0.0, 0.0) for f in (8.0, 12.0, 10.0)]], dtype=wp.vec4)
    vehicle.fly(plan, active=wp.ones(1, dtype=int), phase=phase)
    np.testing.assert_allclose(vehicle.control.numpy()[0], [thrust, 0.1 * thrust, 0.0, 0.0], rtol=1e-6)


def gusts(model, seeds, ticks):
    """Return the wind at each tick [ticks, B, 3] and the final vertical speed [B] of hovering vehicles."""
    count = len(seeds)
    vehicle = Vehicle(model, np.zeros((count, 3)), [0.0] * count, period=0.02, device="cpu", seeds=seeds)
    commands, winds = wp.array([[HOVER]] * count, dtype=wp.vec4), []
    for tick in range(ticks):
        vehicle.fly(commands, active=wp.ones(count, dtype=int), tick=tick)
        winds.append(vehicle.wind.numpy().copy())
    return np.array(winds, dtype=float), vehicle.velocity.numpy()


def test_gusts_are_a_first_order_process():
    winds, _ = gusts(VehicleModel(drag=0.3, gust_speed=2.0, gust_time=0.5), range(300), 40)
    flat = winds.reshape(40, -1)  # 900 independent processes
    for k in (0, 10, 39):  # stationary from the first tick on
        assert flat[k].std() == pytest.approx(2.0, rel=4 / np.sqrt(2 * 900))
        assert abs(flat[k].mean()) < 4 * 2.0 / np.sqrt(900)
    for lag in (1, 25):
        expected = np.exp(-lag * 0.02 / 0.5)
        assert np.corrcoef(flat[5], flat[5 + lag])[0, 1] == pytest.approx(
            expected, abs=4 * (1 - expected**2) / np.sqrt(900)
        )


def test_a_steady_gust_carries_the_drone_along():
    # A gust that lasts: dv = k (w - v), so v = w (1 - exp(-k t)).
    wind, velocity = gusts(VehicleModel(drag=0.8, gust_speed=3.0, gust_time=1e9), [11], 100)
    np.testing.assert_allclose(wind[-1], wind[0], rtol=1e-3)
    np.testing.assert_allclose(velocity[0], wind[0, 0] * (1 - np.exp(-0.8 * 2.0)), rtol=2e-3)


def test_gusts_depend_on_the_seed_not_on_the_batch():
    model = VehicleModel(drag=0.3, gust_speed=1.0)
    together, alone = gusts(model, [4, 5, 6], 5), gusts(model, [5], 5)
    np.testing.assert_array_equal(together[0][:, 1], alone[0][:, 0])
    np.testing.assert_array_equal(together[1][1], alone[1][0])
    assert not np.array_equal(together[0][:, 0], together[0][:, 1])


def test_commands_are_clamped():
    model = VehicleModel()
    wild = run(model, [(99.0, 9.0, -9.0, 9.0), (-5.0, 0.0, 0.0, -9.0)])
    limits = run(model, [(16.35, 3.0, -3.0, 2.0), (0.3, 0.0, 0.0, -2.0)])
    for a, b in zip(wild, limits, strict=True):
        np.testing.assert_array_equal(a, b)


def test_random_controls_match_the_float64_reference():
    rng = np.random.default_rng(0)
    commands = rng.uniform([0.3, -3, -3, -2], [16.35, 3, 3, 2], (100, 4))
    p, v, q, _ = run(VehicleModel(drag=0.1), commands, heading=0.7, velocity=(1.0, -2.0, 0.5))
    state = np.zeros(3), np.array([1.0, -2.0, 0.5]), np.array([np.cos(0.35), 0, 0, np.sin(0.35)])
    for k, command in enumerate(commands.astype(np.float32).astype(float)):
        state = reference(command, *state, step=0.005, steps=4, drag=0.1)
        np.testing.assert_allclose(p[k], state[0], atol=1e-4)
        np.testing.assert_allclose(v[k], state[1], atol=1e-4)
        np.testing.assert_allclose(q[k], state[2], atol=1e-5)


def test_step_divides_any_period():
    # 0.0125 s is no multiple of 5 ms: three shorter steps.
    p, _, _, _ = run(VehicleModel(thrust_min=0.0), [(0.0, 0.0, 0.0, 0.0)] * 8, period=0.0125)
    assert p[-1, 2] == pytest.approx(-0.5 * G * 0.1**2, rel=1e-5)


def test_inactive_vehicles_stand_still():
    vehicle = Vehicle(VehicleModel(), np.zeros((2, 3)), [0.0, 0.0], period=0.02, device="cpu")
    commands = wp.array([[(15.0, 1.0, 0.0, 0.0)]] * 2, dtype=wp.vec4)
    vehicle.fly(commands, active=wp.array([1, 0], dtype=int))
    assert vehicle.position.numpy()[0, 2] > 0.0
    np.testing.assert_array_equal(vehicle.position.numpy()[1], 0.0)
    np.testing.assert_array_equal(vehicle.quaternion.numpy()[1], [1.0, 0.0, 0.0, 0.0])


def test_vehicle_of_a_configuration():
    config = PlannerConfig().replace({"vehicle.mass": 2.5, "vehicle.thrust_max": 50.0})
    model = VehicleModel.from_config(config, drag=0.2)
    assert (model.mass, model.thrust_max, model.drag) == (2.5, 50.0, 0.2)


@pytest.mark.parametrize(
    "changes",
    [
        {"mass": 0.0},
        {"drag": -1.0},
        {"step": float("nan")},
        {"thrust_min": 20.0},
        {"latency": -0.1},
        {"gust_speed": 1.0},
        {"gust_time": 0.0},
    ],
)
def test_invalid_vehicles_are_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        VehicleModel(**changes)
