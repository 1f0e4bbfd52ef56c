import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import PlannerConfig
from aero_planner.kernels import costs
from aero_planner.device.params import Params, pack
from tests.planner import reference
from tests.planner.cases import random_quaternion

wp.set_module_options({"enable_backward": False})


@wp.kernel
def collision_kernel(d: wp.array(dtype=float), params: wp.array(dtype=Params), out: wp.array(dtype=float)):  # type: ignore[valid-type]
    i = wp.tid()
    out[i] = costs.collision_cost(d[i], params[0])


@wp.kernel
def speed_kernel(v: wp.array(dtype=wp.vec3), params: wp.array(dtype=Params), out: wp.array(dtype=float)):  # type: ignore[valid-type]
    i = wp.tid()
    out[i] = costs.speed_cost(v[i], params[0])


@wp.kernel
def goal_kernel(
    p: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    v: wp.array(dtype=wp.vec3),  # type: ignore[valid-type]
    q: wp.array(dtype=wp.vec4),  # type: ignore[valid-type]
    params: wp.array(dtype=Params),  # type: ignore[valid-type]
    out: wp.array(dtype=float),  # type: ignore[valid-type]
):
    """The goal is the last row: out[i] is the cost of row i."""
    i, goal = wp.tid(), p.shape[0] - 1
    out[i] = costs.goal_cost(p[i], v[i], q[i], p[goal], v[goal], q[goal], params[0])


@wp.kernel
def attitude_kernel(q: wp.array(dtype=wp.vec4), q_goal: wp.array(dtype=wp.vec4), out: wp.array(dtype=float)):  # type: ignore[valid-type]
    i = wp.tid()
    out[i] = costs.attitude_distance(q[i], q_goal[i])


def evaluate(
    kernel, device: str, *inputs: np.ndarray, dtypes: tuple, config: PlannerConfig | None = None
) -> np.ndarray:
    arrays = [wp.array(np.asarray(x, np.float32), dtype=t, device=device) for x, t in zip(inputs, dtypes, strict=True)]
    if config is not None:
        params = wp.zeros(1, dtype=Params, device=device)
        params.assign(pack(config)[None])
        arrays.append(params)
    out = wp.zeros(len(inputs[0]), dtype=float, device=device)
    wp.launch(kernel, dim=len(inputs[0]), inputs=[*arrays, out], device=device)
    return out.numpy()


def collision(device: str, d: np.ndarray, config: PlannerConfig) -> np.ndarray:
    return evaluate(collision_kernel, device, d, dtypes=(float,), config=config)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_collision_cost_over_distance(device: str, preset: str):
    config = PlannerConfig.preset(preset)
    d = np.linspace(0.0, 1.5, 400).astype(np.float32)
    expected = reference.J_col(d.astype(np.float64), config)
    # (d_max - d) / (d_max - d_min) near d_max cancels to 6e-8 / 0.27 of 1.
    np.testing.assert_allclose(collision(device, d, config), expected, rtol=2e-6, atol=1e-4)


def test_exponential_edges(device: str):
    """The cost is C up to d_min, C exp(-3) just below d_max, and zero at d_max."""
    config = PlannerConfig.preset("paper")
    d_min, d_max = np.float32(0.4), np.float32(1.0)
    edges = [0.0, np.nextafter(d_min, np.float32(0)), d_min, np.nextafter(d_max, np.float32(0)), d_max, 5.0]
    expected = [1e6, 1e6, 1e6, 1e6 * np.exp(-3.0), 0.0, 0.0]
    np.testing.assert_allclose(collision(device, np.array(edges), config), expected, rtol=1e-6)


def test_quadratic_edges(device: str):
    """The cost is C just below d_min, the soft weight at d_min, a quarter of it half way, and zero from d_max on."""
    config = PlannerConfig()
    d_min, d_max = np.float32(config.costs.distance_min), np.float32(config.costs.distance_max)
    edges = [0.0, np.nextafter(d_min, np.float32(0)), d_min, (d_min + d_max) / 2, d_max, 5.0]
    np.testing.assert_allclose(collision(device, np.array(edges), config), [2e5, 1e5, 200, 50, 0, 0], rtol=1e-6)
    slow = config.replace({"vehicle.speed_limit": 1.4})  # a fifth of soft_speed: five times as many steps in a gap
    np.testing.assert_allclose(collision(device, np.array(edges), slow), [2e5, 1e5, 40, 10, 0, 0], rtol=1e-6)


@settings(max_examples=50, deadline=None)
@given(
    low=st.floats(0.0, 2.0), width=st.floats(0.01, 3.0), d=st.floats(0.0, 6.0),
    shape=st.sampled_from(["exponential", "quadratic"]),
)  # fmt: skip
def test_collision_cost_never_rises_with_distance(device: str, low: float, width: float, d: float, shape: str):
    changes = {"costs.distance_min": low, "costs.distance_max": max(low + width, 0.05), "costs.shape": shape}
    values = collision(device, np.array([d, d + 0.01, d + 0.1, d + 1.0]), PlannerConfig().replace(changes))
    assert (np.diff(values) <= 0.0).all() and (values >= 0.0).all()


def test_speed_cost(device: str):
    config = PlannerConfig().replace({"vehicle.speed_limit": 5.0, "vehicle.descent_limit": 2.0, "costs.q_speed": 10.0})
    v = np.array([[0, 0, 0], [3, 4, 0], [0, 0, 6], [-8, 0, 6], [0, 3, -2], [0, 0, -5], [0, 0, -6]], float)
    result = evaluate(speed_kernel, device, v, dtypes=(wp.vec3,), config=config)
    np.testing.assert_allclose(result, [0.0, 0.0, 10.0, 250.0, 0.0, 90.0, 170.0], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("q_height", [0.0, 3.0])
def test_goal_cost_has_a_part_for_the_difference_in_height(device: str, q_height: float):
    rng, config = np.random.default_rng(5), PlannerConfig().replace({"costs.q_height": q_height})
    p, v = rng.normal(size=(2, 30, 3)).astype(np.float32) * 5.0
    q = np.array([reference.unit(random_quaternion(rng, 3.0)) for _ in range(30)])
    p[0], p[1] = p[-1] + (3.0, 4.0, 0.0), p[-1] - (0.0, 0.0, 2.0)  # level with the goal, and below it
    rows = (reference.Rollout(*(x[i : i + 1].astype(np.float64) for x in (p, q, v))) for i in range(30))
    expected = [reference.J_goal(row, p[-1], v[-1], q[-1], config) for row in rows]
    result = evaluate(goal_kernel, device, p, v, q, dtypes=(wp.vec3, wp.vec3, wp.vec4), config=config)
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_attitude_distance_is_the_frobenius_norm(device: str, seed: int):
    rng = np.random.default_rng(seed)
    q, q_goal = (np.array([reference.unit(random_quaternion(rng, 3.0)) for _ in range(30)]) for _ in range(2))
    # Equal, opposite in sign (the same attitude), and half a turn apart, which is the largest distance.
    q_goal[0], q_goal[1] = q[0], -q[1]
    q_goal[2] = reference.quat_multiply(q[2], np.array([0.0, 0, 0, 1]))
    R = [[reference.rotation(x) for x in both] for both in zip(q, q_goal, strict=True)]
    expected = [np.linalg.norm(a @ b.T - np.eye(3)) for a, b in R]
    result = evaluate(attitude_kernel, device, q, q_goal, dtypes=(wp.vec4, wp.vec4))
    np.testing.assert_allclose(result, expected, atol=2e-6)
    np.testing.assert_allclose(expected[:3], [0.0, 0.0, np.sqrt(8.0)], atol=1e-6)
