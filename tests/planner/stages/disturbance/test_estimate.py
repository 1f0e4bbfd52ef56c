"""Accelerations that the model does not explain, and drag: their estimates, and the plans that count on them."""

import numpy as np
import pytest

from aero_planner import Goal, Plan, Planner, PlannerConfig, VehicleState
from aero_planner.stages.stop_proof.stops import STOPS
from tests.planner import reference
from tests.planner.cases import config_of
from tests.planner.reference import Array

PERIOD = 0.1
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
NO_POINTS = np.zeros((0, 3), np.float32)


def make_planner(device: str, **changes: float) -> Planner:
    """Return a planner whose time step divides `PERIOD`."""
    return Planner(config_of("default", sampling__dt=0.05, **changes), device=device)


def estimated(planner: Planner, name: str) -> Array:
    """Return an array of the estimate of a single drone."""
    return planner.arrays_of("disturbance")[name].numpy()[0]


def thrust_and_gravity(command: Array, config: PlannerConfig) -> Array:
    """Return the acceleration of a level drone under the command that a plan holds `PERIOD` after its start."""
    thrust = float(command[int(PERIOD / config.sampling.dt), 0])
    return np.array([0.0, 0.0, thrust / config.vehicle.mass - config.vehicle.gravity])


def plan_in_wind(
    planner: Planner, wind: Array | None, *, plans: int = 6, velocity: Array | None = None, drag: float = 0.0
) -> Plan:
    """Plan for a level drone that `wind` accelerates [m/s^2] and `drag` slows down [1/s]; None: it is not known."""
    velocity = np.array([2.0, 1.0, 0.0]) if velocity is None else velocity
    acceleration: Array | None = np.zeros(3)
    for k in range(plans):
        state = VehicleState(np.zeros(3), velocity, LEVEL, acceleration, time=PERIOD * k)
        plan = planner.plan(state, Goal([20.0, 3.0, 1.0]), NO_POINTS)
        command = np.asarray(plan.command, np.float64)
        acceleration = None if wind is None else thrust_and_gravity(command, planner.config) + wind - drag * velocity
    return plan  # pyright: ignore[reportPossiblyUnboundVariable]


@pytest.mark.parametrize(
    ("wind", "believed"),
    [((0.4, -0.2, 0.3), (0.4, -0.2, 0.3)), ((-0.4, 0.1, -0.3), (-0.4, 0.1, -0.3)), ((0.0, 0.0, 12.0), (0.0, 0.0, 3.0))],
)
def test_a_disturbance_is_averaged_up_to_what_is_believed(
    device: str, wind: tuple[float, ...], believed: tuple[float, ...]
):
    planner = make_planner(device, disturbance__disturbance_time=0.3)
    plan_in_wind(planner, np.array(wind), plans=6)
    expected = np.array(believed) * (1.0 - np.exp(-5 * PERIOD / 0.3))
    np.testing.assert_allclose(estimated(planner, "mean_disturbance"), expected, atol=1e-4)


def test_plans_do_not_count_on_what_slows_the_drone_down(device: str):
    planner = make_planner(device, disturbance__disturbance_time=0.01)
    velocity = np.array([3.0, 0.0, 4.0])
    for wind, counted in (((-1.0, 0.5, 0.0), (-0.64, 0.5, 0.48)), ((1.0, 0.5, 0.0), (1.0, 0.5, 0.0))):
        planner.reset()
        plan_in_wind(planner, np.array(wind), velocity=velocity)
        np.testing.assert_allclose(planner.outputs.disturbance.numpy()[0], counted, atol=1e-3)


@pytest.mark.parametrize(("time", "wind", "plans"), [(0.0, np.ones(3), 4), (0.2, None, 4), (0.2, np.ones(3), 1)])
def test_there_is_no_disturbance_without_an_estimate(device: str, time: float, wind: Array | None, plans: int):
    """It is switched off, or no acceleration is known, or there is no plan before."""
    planner = make_planner(device, disturbance__disturbance_time=time)
    plan_in_wind(planner, wind, plans=plans)
    assert not estimated(planner, "mean_disturbance").any() and not planner.outputs.disturbance.numpy().any()


def test_it_is_forgotten_while_nothing_was_planned(device: str):
    planner = make_planner(device, disturbance__disturbance_time=0.2)
    plan_in_wind(planner, np.ones(3))
    late = PERIOD * 5 + planner.config.horizon + 0.1
    planner.plan(VehicleState(np.zeros(3), np.ones(3), LEVEL, np.ones(3), late), Goal([20.0, 3.0, 1.0]), NO_POINTS)
    assert not estimated(planner, "mean_disturbance").any()


def test_a_disturbance_can_be_given(device: str):
    planner = make_planner(device, disturbance__disturbance_time=0.2)
    for given, believed in (((0.0, 0.3, -0.4), (0.0, 0.3, -0.4)), ((0.0, 0.0, -5.0), (0.0, 0.0, -3.0))):
        state = VehicleState(np.zeros(3), np.zeros(3), LEVEL, np.ones(3), disturbance=given)
        planner.plan(state, Goal([20.0, 3.0, 1.0]), NO_POINTS)
        np.testing.assert_allclose(planner.outputs.disturbance.numpy()[0], believed, atol=1e-6)


@pytest.mark.parametrize(("drag", "wind"), [(0.25, (0.0, 0.0, 0.0)), (0.3, (-0.2, 0.6, 0.3)), (0.8, (0.0, 0.0, 0.0))])
def test_drag_and_disturbance_are_told_apart(device: str, drag: float, wind: tuple[float, float, float]):
    """Drag is what a disturbance across the velocity is not; more than 0.5 1/s is not believed."""
    planner = make_planner(device, disturbance__disturbance_time=0.01, disturbance__drag_time=1.0)
    velocity = np.array([3.0, 1.0, 0.0])
    plan_in_wind(planner, np.array(wind), plans=21, velocity=velocity, drag=drag)
    square = 10.0 * (1.0 - np.exp(-2.0))
    np.testing.assert_allclose(estimated(planner, "drag_means"), [min(drag, 0.5) * square, square], rtol=1e-4)
    believed = min(drag, 0.5) * square / (square + 1.0)
    assert planner.outputs.drag.numpy()[0] == pytest.approx(believed, rel=1e-4)
    rest = np.array(wind) + (believed - drag) * velocity
    np.testing.assert_allclose(estimated(planner, "mean_disturbance"), rest, atol=1e-3)


def test_drag_is_not_negative_and_is_forgotten_in_a_new_flight(device: str):
    planner = make_planner(device, disturbance__drag_time=1.0)
    plan_in_wind(planner, np.zeros(3), drag=-0.25)
    assert planner.outputs.drag.numpy()[0] == 0.0
    plan_in_wind(planner, np.zeros(3), drag=0.25)
    assert planner.outputs.drag.numpy()[0] > 0.1
    planner.reset()
    plan_in_wind(planner, np.zeros(3), plans=1, drag=0.25)
    assert planner.outputs.drag.numpy()[0] == 0.0


def test_drag_is_found_in_a_disturbance_that_is_given(device: str):
    planner = make_planner(device, disturbance__disturbance_time=0.2, disturbance__drag_time=1.0)
    velocity = np.array([0.0, 4.0, 3.0])
    for k in range(30):
        given = np.array([0.5, 0.0, 0.0]) - 0.2 * velocity
        state = VehicleState(np.zeros(3), velocity, LEVEL, time=PERIOD * k, disturbance=given)
        planner.plan(state, Goal([20.0, 3.0, 1.0]), NO_POINTS)
    assert planner.outputs.drag.numpy()[0] == pytest.approx(0.2, abs=0.01)
    np.testing.assert_allclose(planner.outputs.disturbance.numpy()[0], [0.5, 0.0, 0.0], atol=0.05)


@pytest.mark.parametrize("drag", [0.0, 0.25])
@pytest.mark.parametrize("delay", [0.0, 0.05])
def test_guides_rollouts_and_stops_count_on_them(device: str, delay: float, drag: float):
    changes = {"disturbance__disturbance_time": 0.01, "disturbance__drag_time": 0.01, "vehicle__delay": delay}
    planner = make_planner(device, **changes)
    config, velocity, wind = planner.config, np.array([2.0, 1.0, 0.5]), np.array([0.5, -0.8, 0.6])
    plan = plan_in_wind(planner, wind, velocity=velocity, drag=drag)
    work, stops, N = planner.workspace, planner.arrays_of("stop_proof"), config.sampling.steps
    assert plan.disturbance is not None and plan.drag is not None
    disturbance, k = plan.disturbance.astype(np.float64), float(plan.drag)
    position, velocity, quaternion = (
        getattr(work, name).numpy()[0].astype(np.float64) for name in ("position", "velocity", "quaternion")
    )
    assert np.linalg.norm(disturbance) > 0.5 and (k > 0.05) == (drag > 0.0)  # a first estimate
    for m in range(config.anchor_count):
        forward = reference.rotation(quaternion)[:, 0]
        yaw = np.arctan2(3.0 - position[1], 20.0 - position[0]) - np.arctan2(forward[1], forward[0])
        expected = reference.follow_guide(
            plan.guide_coefficients[m].astype(np.float64), quaternion, yaw / config.horizon,
            work.control.numpy()[0], config, disturbance, k,
        )  # fmt: skip
        np.testing.assert_allclose(work.nominal_controls.numpy()[0, m], expected, atol=0.02)
        x = reference.roll_out(
            position, quaternion, velocity, plan.controls[m], config, disturbance=disturbance, drag=k
        )
        np.testing.assert_allclose(plan.positions[m, 1:], x.p, atol=2e-3)
    m = int(plan.best)
    controls = np.concatenate((plan.controls[m, : N // 2], stops["stop_controls"].numpy()[0, m * int(STOPS) + 4]))
    x = reference.roll_out(position, quaternion, velocity, controls, config, disturbance=disturbance, drag=k)
    np.testing.assert_allclose(stops["stop_positions"].numpy()[0, m * int(STOPS) + 4, 1:], x.p[N // 2 :], atol=4e-3)


def test_a_drone_that_brakes_does_not_drift_with_the_wind(device: str):
    """Braking begins anew in every plan, and takes a horizon each time: without the estimate, the drone rises."""
    rise = {}
    for time in (0.0, 0.2):
        planner = make_planner(device, disturbance__disturbance_time=time)
        config, wind = planner.config.replace({"sampling.dt": PERIOD}), np.array([0.0, 0.0, 0.4])
        position, velocity, quaternion, acceleration = np.zeros(3), np.array([1.0, 0.0, 0.0]), LEVEL, np.zeros(3)
        for k in range(25):
            state = VehicleState(position, velocity, quaternion, acceleration, time=PERIOD * k)
            plan = planner.plan(state, Goal([20.0, 0.0, 0.0]), NO_POINTS, cloud_age=9.0)  # too old to go on
            command = np.asarray(plan.command, np.float64)[:1]
            x = reference.roll_out(position, quaternion, velocity, command, config, disturbance=wind)
            position, velocity, quaternion = x.p[0], x.v[0], x.q[0]
            thrust = float(plan.command[int(PERIOD / planner.config.sampling.dt), 0])
            thrust_acceleration = reference.rotation(quaternion)[:, 2] * thrust / config.vehicle.mass
            acceleration = thrust_acceleration - [0.0, 0.0, config.vehicle.gravity] + wind
        rise[time] = position[2], velocity[2]
    assert rise[0.0][1] > 0.2 and rise[0.2][1] < 0.1 and rise[0.2][0] < 0.5 * rise[0.0][0]
