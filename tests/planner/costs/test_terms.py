"""Every cost term against its equation."""

# Postponed annotations are left out: the kernels below refer to local types.

import functools
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from aero_planner import PlannerConfig
from aero_planner.costs import End, Step
from aero_planner.costs.terms import TERMS, attitude_distance
from aero_planner.device.params import Params, pack
from tests.planner import reference
from tests.planner.cases import exact, random_quaternion
from tests.planner.reference import Array

BY_NAME = {term.name: term for term in TERMS}


@functools.cache
def kernel_of(function: Any, struct: Any, *, is_terminal: bool = False) -> Any:
    """Return the kernel that evaluates a function of a struct, or of a number, and the parameters."""

    @wp.kernel(module="unique", enable_backward=False)
    def running(values: wp.array(dtype=struct), params: wp.array(dtype=Params), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = function(values[i], params[0])

    @wp.kernel(module="unique", enable_backward=False)
    def terminal(values: wp.array(dtype=struct), params: wp.array(dtype=Params), out: wp.array(dtype=float)):
        i = wp.tid()
        out[i] = function(values[i], 0, params[0])

    return terminal if is_terminal else running


def evaluate(kernel: Any, device: str, values: np.ndarray, dtype: Any, config: PlannerConfig) -> np.ndarray:
    params = wp.array(np.array([pack(config)]), dtype=Params, device=device)
    out = wp.zeros(len(values), dtype=float, device=device)
    wp.launch(kernel, len(values), inputs=[wp.array(values, dtype=dtype, device=device), params, out], device=device)
    return out.numpy()


def collision(device: str, d: np.ndarray, config: PlannerConfig) -> np.ndarray:
    return evaluate(kernel_of(BY_NAME["obstacles"].obstacle, float), device, d.astype(np.float32), float, config)


def random_steps(rng: np.random.Generator, steps: int) -> tuple[np.ndarray, dict[str, Array]]:
    """Return the time steps of a random rollout as the terms see them, and as arrays by name."""
    x = {name: exact(rng.normal(size=(steps, 3)) * 4.0) for name in ("p", "v", "p_guide")}
    x["q"] = exact([reference.unit(random_quaternion(rng, 3.0)) for _ in range(steps)])
    x["u"], x["command"] = exact(rng.normal(size=(steps, 4)) * 3.0), exact(rng.normal(size=4))
    goal = {name: exact(rng.normal(size=3)) for name in ("p_goal", "v_goal")}
    goal["q_goal"] = exact(reference.unit(random_quaternion(rng, 3.0)))
    dtype: Any = Step.numpy_dtype()
    records = np.zeros(steps, dtype=np.dtype(dtype))
    records["t"], records["last"], records["is_guided"] = np.arange(steps), steps - 1, 1
    for name in ("p", "v", "q", "u", "p_guide"):
        records[name] = x[name]
    records["u_before"] = np.concatenate((x["command"][None], x["u"][:-1]))
    for name, value in goal.items():
        records[name] = value
    return records, x | goal


def random_weights(rng: np.random.Generator) -> PlannerConfig:
    """Return a configuration in which all weights differ from each other and from 0."""
    names = [info.path for info in PlannerConfig.parameters() if info.name.startswith("q_")]
    weights = {name: float(weight) for name, weight in zip(names, rng.permutation(len(names)) + 1.5, strict=True)}
    return PlannerConfig().replace(weights | {"vehicle.speed_limit": 4.0})


@pytest.mark.parametrize("steps", [2, 3, 9])
def test_running_terms(device: str, steps: int):
    rng = np.random.default_rng(steps)
    config = random_weights(rng)
    records, x = random_steps(rng, steps)
    expected = {
        "guide_tracking": reference.J_track(x["p"], x["p_guide"], config),
        "speed": reference.J_vnorm(x["v"], config),
        "control_effort": reference.J_effort(x["u"], config),
        "control_change": reference.J_change(x["u"], config),
        "goal_position": reference.J_position(x["p"], x["p_goal"], config),
        "goal_velocity": reference.J_velocity(x["v"], x["v_goal"], config),
        "goal_attitude": reference.J_attitude(x["q"], x["q_goal"], config),
        "speed_limit": reference.J_speed(x["v"], config),
        "control_jump": reference.J_jump(x["u"], x["command"], config),
    }
    assert set(expected) == {term.name for term in TERMS if term.running is not None}
    for name, values in expected.items():
        found = evaluate(kernel_of(BY_NAME[name].running, Step), device, records, Step, config)
        np.testing.assert_allclose(found, values, rtol=1e-5, atol=1e-5, err_msg=name)
        assert values.any() or steps < 9


def test_speed_costs_beyond_the_limit(device: str):
    config = PlannerConfig().replace({"vehicle.speed_limit": 5.0, "costs.q_speed": 10.0})
    records, _ = random_steps(np.random.default_rng(0), 6)
    records["v"] = [(0, 0, 0), (3, 4, 0), (0, 0, 6), (-8, 0, 6), (0, 3, -2), (0, 0, -6)]
    found = evaluate(kernel_of(BY_NAME["speed_limit"].running, Step), device, records, Step, config)
    np.testing.assert_allclose(found, [0.0, 0.0, 10.0, 250.0, 0.0, 10.0], rtol=1e-5, atol=1e-6)


def test_the_previous_plan_tracks_no_guide(device: str):
    records, _ = random_steps(np.random.default_rng(0), 5)
    records["is_guided"] = 0
    found = evaluate(kernel_of(BY_NAME["guide_tracking"].running, Step), device, records, Step, PlannerConfig())
    assert not found.any()


def test_the_cost_to_go_is_the_blocked_length(device: str):
    config = PlannerConfig().replace({"costs.q_blocked": 3.0, "anchors.lookahead": 4.0})
    dtype: Any = End.numpy_dtype()
    ends = np.zeros(4, dtype=np.dtype(dtype))
    ends["p"] = (1.0, 2.0, 3.0)
    ends["p_goal"] = [(1.0, 2.0, 13.0), (1.0, 5.0, 3.0), (1.0, 5.0, 3.0), (1.0, 2.0, 3.0)]
    ends["blocked"] = [0.5, 0.5, 0.0, 1.0]
    found = evaluate(kernel_of(BY_NAME["blocked_path"].terminal, End, is_terminal=True), device, ends, End, config)
    np.testing.assert_allclose(found, [6.0, 4.5, 0.0, 0.0], rtol=1e-6)


def test_terms_belong_to_the_sums_of_the_paper():
    assert [term.name for term in TERMS if not term.in_stage2] == [
        "guide_tracking", "speed", "control_effort", "control_change"
    ]  # fmt: skip
    assert all(term.in_stage1 for term in TERMS)
    assert {term.sum for term in TERMS} == {"J_track", "J_vnorm", "J_ctrl", "J_goal", "J_col", ""}
    assert [term.name for term in TERMS if term.sum == "J_goal"] == ["goal_position", "goal_velocity", "goal_attitude"]


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_collision_cost_over_distance(device: str, preset: str):
    config = PlannerConfig.preset(preset)
    d = np.linspace(0.0, 1.5, 400).astype(np.float32)
    expected = reference.J_col(d.astype(np.float64), config)
    # (d_max - d) / (d_max - d_min) near d_max cancels to 6e-8 / 0.25 of 1.
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


@settings(max_examples=50, deadline=None)
@given(
    low=st.floats(0.0, 2.0), width=st.floats(0.01, 3.0), d=st.floats(0.0, 6.0),
    shape=st.sampled_from(["exponential", "quadratic"]),
)  # fmt: skip
def test_collision_cost_never_rises_with_distance(device: str, low: float, width: float, d: float, shape: str):
    changes = {"costs.distance_min": low, "costs.distance_max": max(low + width, 0.05), "costs.shape": shape}
    values = collision(device, np.array([d, d + 0.01, d + 0.1, d + 1.0]), PlannerConfig().replace(changes))
    assert (np.diff(values) <= 0.0).all() and (values >= 0.0).all()


@wp.kernel
def attitude_kernel(q: wp.array(dtype=wp.vec4), q_goal: wp.array(dtype=wp.vec4), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = attitude_distance(q[i], q_goal[i])


@pytest.mark.parametrize("seed", range(4))
def test_attitude_distance_is_the_frobenius_norm(device: str, seed: int):
    rng = np.random.default_rng(seed)
    q, q_goal = (np.array([reference.unit(random_quaternion(rng, 3.0)) for _ in range(30)]) for _ in range(2))
    # Equal, opposite in sign (the same attitude), and half a turn apart, which is the largest distance.
    q_goal[0], q_goal[1] = q[0], -q[1]
    q_goal[2] = reference.quat_multiply(q[2], np.array([0.0, 0, 0, 1]))
    R = [[reference.rotation(x) for x in both] for both in zip(q, q_goal, strict=True)]
    expected = [np.linalg.norm(a @ b.T - np.eye(3)) for a, b in R]
    out = wp.zeros(30, dtype=float, device=device)
    inputs = [wp.array(x.astype(np.float32), dtype=wp.vec4, device=device) for x in (q, q_goal)]
    wp.launch(attitude_kernel, 30, inputs=inputs, outputs=[out], device=device)
    np.testing.assert_allclose(out.numpy(), expected, atol=2e-6)
    np.testing.assert_allclose(expected[:3], [0.0, 0.0, np.sqrt(8.0)], atol=1e-6)
