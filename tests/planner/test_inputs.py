import numpy as np
import pytest
import warp as wp

from aero_planner import BatchPlan, Goal, Planner, VehicleState
from tests.planner.cases import config_of

NAN, INF = np.nan, np.inf
STATE = {"position": (0, 0, 0), "velocity": (0, 0, 0), "quaternion": (1, 0, 0, 0)}
CLOUD = np.zeros((5, 3), np.float32)


@pytest.fixture(scope="module")
def planner(device: str) -> Planner:
    return Planner(config_of(), device=device)


@pytest.fixture(scope="module")
def trio(device: str) -> Planner[BatchPlan]:
    return Planner(config_of(), device=device, batch=3)


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("position", (0, NAN, 0), "every value must be finite"),
        ("position", (0, 0), r"has shape \(2,\); it must have shape \(3,\)"),
        ("position", ((0, 0, 0),), r"has shape \(1, 3\)"),
        ("position", None, r"has shape \(\)|is None"),
        ("position", "here", "it must be numbers of shape"),
        ("position", ((0, 0), 0, 0), "it must be numbers of shape"),
        ("position", (1e7, 0, 0), "no precision left in float32"),
        ("velocity", (INF, 0, 0), "every value must be finite"),
        ("quaternion", (0, 0, 0, 0), "is zero; give a unit quaternion"),
        ("quaternion", (1, 0, 0), r"it must have shape \(4,\)"),
        ("quaternion", (NAN, 0, 0, 0), "every value must be finite"),
        ("acceleration", (0, 0, NAN), "every value must be finite"),
        ("time", NAN, "every value must be finite"),
        ("time", (1.0, 2.0), "has shape"),
    ],
)
def test_bad_states(planner: Planner, field: str, value: object, problem: str):
    with pytest.raises(ValueError, match=f"^state.{field} .*{problem}"):
        planner.plan(VehicleState(**(STATE | {field: value})), Goal((5, 0, 0)), CLOUD)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("position", (INF, 0, 0), "every value must be finite"),
        ("position", (0, 0, 0, 0), "has shape"),
        ("velocity", (NAN, 0, 0), "every value must be finite"),
        ("quaternion", (0, 0, 0, 0), "is zero"),
    ],
)
def test_bad_goals(planner: Planner, field: str, value: object, problem: str):
    goal = Goal(**({"position": (5, 0, 0)} | {field: value}))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=f"^goal.{field} .*{problem}"):
        planner.plan(VehicleState(**STATE), goal, CLOUD)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((5, 2), np.float32), np.zeros(3), np.zeros((2, 5, 3)), np.zeros((5, 3), bool),
        np.zeros((5, 3), complex), [["a", "b", "c"]], [[1, 2], [3]], None, "cloud", np.zeros((5, 3), object),
    ],
)  # fmt: skip
def test_bad_clouds(planner: Planner, points: object):
    with pytest.raises(ValueError, match=r"^points "):
        planner.plan(VehicleState(**STATE), Goal((5, 0, 0)), points)  # type: ignore[arg-type]


def test_bad_warp_clouds(planner: Planner):
    for points, problem in [
        (wp.zeros((5, 3), dtype=float, device="cpu"), "must have dtype wp.vec3"),
        (wp.zeros(5, dtype=wp.vec3d, device="cpu"), "must have dtype wp.vec3"),
        (wp.zeros((2, 5), dtype=wp.vec3, device="cpu"), "it must have 1"),
    ]:
        with pytest.raises(ValueError, match=f"^points .*{problem}"):
            planner.plan(VehicleState(**STATE), Goal((5, 0, 0)), points)


@pytest.mark.parametrize("age", [NAN, "old", (1.0, 2.0)])
def test_bad_cloud_ages(planner: Planner, age: object):
    with pytest.raises(ValueError, match=r"^cloud_age "):
        planner.plan(VehicleState(**STATE), Goal((5, 0, 0)), CLOUD, cloud_age=age)  # type: ignore[arg-type]


@pytest.mark.parametrize("ground", [np.nan, np.inf, 2e6, "high", [1.0, 2.0]])
def test_bad_ground_heights(planner: Planner, ground: object):
    with pytest.raises(ValueError, match="ground_height"):
        planner.plan(VehicleState(**STATE), Goal((5, 0, 0)), CLOUD, ground_height=ground)  # type: ignore[arg-type]


def test_batches_have_a_leading_axis(trio: Planner[BatchPlan]):
    state = VehicleState(np.zeros((3, 3)), np.zeros((3, 3)), np.tile([1.0, 0, 0, 0], (3, 1)))
    goal = Goal(np.ones((3, 3)))
    with pytest.raises(ValueError, match=r"^state.position has shape \(3,\); it must have shape \(3, 3\)"):
        trio.plan(VehicleState(**STATE), goal, [CLOUD] * 3)
    with pytest.raises(ValueError, match=r"^points holds 2 clouds; the batch has 3 drones"):
        trio.plan(state, goal, [CLOUD] * 2)
    with pytest.raises(ValueError, match=r"^points holds 5 clouds|^points has shape \(3,\)"):
        trio.plan(state, goal, CLOUD)
    with pytest.raises(ValueError, match=r"^points "):
        trio.plan(state, goal, None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"^points .* it must have 2"):
        trio.plan(state, goal, wp.zeros(5, dtype=wp.vec3, device="cpu"))
    one_zero = np.tile([1.0, 0, 0, 0], (3, 1))
    one_zero[1] = 0
    with pytest.raises(ValueError, match=r"^state.quaternion is zero"):
        trio.plan(VehicleState(np.zeros((3, 3)), np.zeros((3, 3)), one_zero), goal, [CLOUD] * 3)


def test_bad_input_changes_nothing(planner: Planner):
    history = planner.history()
    for points in (np.zeros((5, 2)), None):
        with pytest.raises(ValueError):
            planner.plan(VehicleState(**STATE), Goal((5, 0, 0)), points)  # type: ignore[arg-type]
    after = planner.history()
    for name, array in history.arrays.items():
        np.testing.assert_array_equal(after.arrays[name], array, err_msg=name)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"device": "gpu"}, "device 'gpu' is not available: this machine has cpu.*; choose "),
        ({"device": "cuda:99"}, "device 'cuda:99' is not available"),
        ({"batch": 0}, "batch is 0; it must be None or a whole number of at least 1"),
        ({"batch": "2"}, "batch is '2'; it must be None or a whole number"),
        ({"batch": 2.0}, "batch is 2.0; it must be None or a whole number"),
        ({"threads": 0}, "threads is 0; it must be None or a whole number of at least 1"),
        ({"config": "paper"}, "config is 'paper'; it must be a PlannerConfig"),
        ({"seed": 1.5}, "seed is 1.5; it must be a whole number"),
    ],
)
def test_bad_planners(arguments: dict, problem: str):
    with pytest.raises(ValueError, match=problem):
        Planner(**arguments)


def test_another_configuration_has_to_be_one(planner: Planner):
    before = planner.config
    for config in ({"costs.q_track": 8.0}, [{}], None):
        with pytest.raises(ValueError, match="it must be a PlannerConfig"):
            planner.configure(config)  # type: ignore[arg-type]
    assert planner.config is before
