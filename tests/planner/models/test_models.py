"""What every vehicle model must do: stay in hover, keep its bounds, follow its guides and stop."""

# Postponed annotations are left out: the kernels below refer to local types.

import functools
from typing import Any

import numpy as np
import pytest
import warp as wp

from aero_planner import Goal, Planner, PlannerConfig, PlanStatus, VehicleState, registry
from aero_planner.device.params import Params, pack
from aero_planner.models.vehicle_model import VehicleModel
from tests.planner import reference
from tests.planner.cases import Case, config_of, random_case
from tests.planner.reference import Array

MODELS = registry.names("models")


@functools.cache
def roll_out_kernel(model: VehicleModel) -> Any:
    constants, step = model.constants, model.step

    @wp.kernel(module="unique", enable_backward=False)
    def roll_out(
        p0: wp.vec3, v0: wp.vec3, q0: wp.vec4, acting0: wp.vec4, controls: wp.array(dtype=wp.vec4), d: wp.vec3,
        k: float, params: wp.array(dtype=Params), p: wp.array(dtype=wp.vec3), v: wp.array(dtype=wp.vec3),
        q: wp.array(dtype=wp.vec4), acting: wp.array(dtype=wp.vec4),
    ):  # fmt: skip
        x = p0
        y = v0
        z = q0
        a = acting0
        c = constants(d, k, params[0].dt, params[0])
        for t in range(controls.shape[0]):
            x, y, z, a = step(x, y, z, a, controls[t], c)
            p[t] = x
            v[t] = y
            q[t] = z
            acting[t] = a

    return roll_out


@functools.cache
def function_kernel(function: Any, has_control: bool) -> Any:
    """Return the kernel that evaluates a function of the parameters, and of a control before them if it has one."""

    @wp.kernel(module="unique", enable_backward=False)
    def of_control(u: wp.array(dtype=wp.vec4), params: wp.array(dtype=Params), out: wp.array(dtype=wp.vec4)):
        out[wp.tid()] = function(u[wp.tid()], params[0])

    @wp.kernel(module="unique", enable_backward=False)
    def constant(u: wp.array(dtype=wp.vec4), params: wp.array(dtype=Params), out: wp.array(dtype=wp.vec4)):
        out[wp.tid()] = function(params[0])

    return of_control if has_control else constant


def params_of(config: PlannerConfig, device: str) -> wp.array:
    return wp.array(np.array([pack(config)]), dtype=Params, device=device)


def roll_out(
    name: str, config: PlannerConfig, device: str, v0: Array, q0: Array, acting: Array, controls: Array,
    disturbance: Array = reference.NO_DISTURBANCE, drag: float = 0.0,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return p, v, q and the acting controls after each control, from the origin."""
    n = len(controls)
    out = [wp.zeros(n, dtype=dtype, device=device) for dtype in (wp.vec3, wp.vec3, wp.vec4, wp.vec4)]
    inputs = [
        wp.vec3(), wp.vec3(*v0), wp.vec4(*q0), wp.vec4(*acting), wp.array(controls, dtype=wp.vec4, device=device),
        wp.vec3(*disturbance), drag, params_of(config, device),
    ]  # fmt: skip
    wp.launch(roll_out_kernel(registry.load("models", name)), 1, inputs=inputs, outputs=out, device=device)
    p, v, q, acting = (array.numpy().astype(np.float64) for array in out)
    return p, v, q, acting


def control(name: str, function: str, config: PlannerConfig, device: str, u: Array | None = None) -> Array:
    """Return what a function of the model makes of controls [n, 4], or of nothing."""
    values = np.zeros((1, 4)) if u is None else u
    out = wp.zeros(len(values), dtype=wp.vec4, device=device)
    kernel = function_kernel(getattr(registry.load("models", name), function), u is not None)
    inputs = [wp.array(values.astype(np.float32), dtype=wp.vec4, device=device), params_of(config, device)]
    wp.launch(kernel, len(values), inputs=inputs, outputs=[out], device=device)
    return out.numpy().astype(np.float64)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_hover_stays(device: str, name: str, heading: float):
    config = config_of("px4", vehicle__mass=1.3)
    hover = control(name, "hover", config, device)
    level = np.array([np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)])
    p, v, q, acting = roll_out(name, config, device, np.zeros(3), level, hover[0], np.repeat(hover, 40, axis=0))
    np.testing.assert_allclose(p, np.zeros((40, 3)), atol=1e-5)
    np.testing.assert_allclose(v, np.zeros((40, 3)), atol=1e-5)
    np.testing.assert_allclose(q, np.tile(level, (40, 1)), atol=1e-6)
    np.testing.assert_allclose(acting, np.repeat(hover, 40, axis=0), rtol=1e-6)
    np.testing.assert_allclose(control(name, "clamp", config, device, hover), hover, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", MODELS)
def test_clamped_controls_stay_as_they_are(device: str, name: str):
    config, rng = config_of(), np.random.default_rng(0)
    once = control(name, "clamp", config, device, rng.normal(size=(200, 4)) * 30.0)
    np.testing.assert_allclose(control(name, "clamp", config, device, once), once, rtol=1e-5, atol=1e-5)
    inside = control(name, "clamp", config, device, 0.5 * once + 0.5 * control(name, "hover", config, device))
    np.testing.assert_allclose(inside, 0.5 * once + 0.5 * control(name, "hover", config, device), rtol=1e-5, atol=1e-5)


def gentle(seed: int) -> Case:
    """Return a nearly resting level drone in open space."""
    case = random_case(seed, speed=0.0, tilt=0.0, count=0)
    case.velocity, case.acceleration = np.random.default_rng(seed).normal(size=3) * 0.2, np.zeros(3)
    return case


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("seed", range(3))
def test_nominal_controls_fly_along_gentle_guides(device: str, name: str, seed: int):
    config = config_of("paper", anchors__lookahead=0.8, vehicle__model=name)
    case, planner = gentle(seed), Planner(config, device=device)
    plan = case.plan(planner)
    hover = control(name, "hover", config, device)[0]
    for m in range(15):
        nominal = planner.workspace.nominal_controls.numpy()[0, m]
        p, _, q, _ = roll_out(name, config, device, case.velocity, reference.unit(case.quaternion), hover, nominal)
        flown = case.position + p
        assert np.linalg.norm(flown - plan.guides[m, 1:], axis=1).max() < 0.1
        assert np.linalg.norm(plan.guides[m, -1] - plan.guides[m, 0]) > 0.7
        np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-5)
        np.testing.assert_allclose(control(name, "clamp", config, device, nominal), nominal, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_nominal_controls_count_on_disturbance_and_drag(device: str, name: str):
    """Without that the wind would blow the drone off its guide."""
    wind, case = np.array([1.0, -1.5, 0.5]), gentle(1)
    case.velocity = np.array([1.0, 0.5, 0.0])
    config = config_of("paper", anchors__lookahead=0.8, vehicle__model=name, stages__active="disturbance")
    config = config.replace({"disturbance.disturbance_time": 0.1, "disturbance.drag_time": 1.0})
    planner = Planner(config, device=device)
    for k in range(8):
        given = wind - 0.4 * case.velocity
        state = VehicleState(
            case.position, case.velocity, case.quaternion, np.zeros(3), time=0.1 * k, disturbance=given
        )
        plan = planner.plan(state, Goal(case.goal), case.points)
    outputs = planner.outputs
    disturbance, drag = outputs.disturbance.numpy()[0].astype(float), float(outputs.drag.numpy()[0])
    assert drag > 0.05 and np.linalg.norm(disturbance) > 1.0
    work, misses = planner.workspace, []
    nominal, acting = work.nominal_controls.numpy()[0, 7], work.control.numpy()[0]
    for counted in (1.0, 0.0):
        p, *_ = roll_out(
            name, config, device, case.velocity, reference.unit(case.quaternion), acting, nominal,
            counted * disturbance, counted * drag,
        )  # fmt: skip
        guide = plan.guides[7, -1]  # pyright: ignore[reportPossiblyUnboundVariable]
        misses.append(np.linalg.norm(case.position + p[-1] - guide))
    assert misses[0] < 0.35 and misses[1] > misses[0] + 0.4


@pytest.mark.parametrize("name", MODELS)
def test_braking_candidates_stop(device: str, name: str):
    config = config_of(vehicle__model=name)
    case, planner = gentle(0), Planner(config, device=device)
    case.velocity = np.array([3.0, 0.0, 0.0])
    plan = case.plan(planner, cloud_age=9.0)
    assert plan.status == PlanStatus.STALE_CLOUD and plan.braking is not None
    assert np.linalg.norm(plan.braking.velocities[:, -1], axis=-1).max() < 1.0


@pytest.mark.parametrize("name", MODELS)
def test_open_space_leads_to_the_goal(device: str, name: str):
    case = random_case(0, count=0, tilt=0.3)
    plan = case.plan(Planner(config_of(vehicle__model=name), device=device))
    assert plan.status == PlanStatus.OK
    before = np.linalg.norm(case.goal - case.position)
    assert np.linalg.norm(case.goal - plan.positions[plan.best, -1]) < before - 0.5


def test_each_model_names_its_controls():
    for name in MODELS:
        model = registry.load("models", name)
        assert model.name == name and len(model.controls) == 4 and model.label
