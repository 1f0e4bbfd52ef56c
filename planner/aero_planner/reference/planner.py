"""The stages of the paper in their order, and the planner that launches them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.array_memory import allocate, as_dict
from aero_planner.config import PlannerConfig
from aero_planner.plan import Goal, Plan, PlanStatus, VehicleState
from aero_planner.plan_inputs import check_inputs
from aero_planner.quaternions import rotate
from aero_planner.reference import anchors, costs, dynamics, guides, mppi, partition, selection
from aero_planner.reference.arrays import ReferenceArrays
from aero_planner.reference.parameters import parameters_of
from aero_planner.warp_init import find_device

STAGES: dict[str, list[tuple[Any, str, str]]] = {
    "anchors": [
        (anchors.place_anchors, "M", "x0 goal M_h c directions initial_endpoints"),
    ],
    "partition": [
        (partition.clear_cells, "F0 F1", "keys dropped_points"),
        (partition.find_nearest_points, "P", "x0 c points keys dropped_points"),
        (partition.fine_partition, "F0 F1", "c points keys fine_range filtered_points"),
        (partition.coarse_partition, "C0 C1", "directions fine_range safe_range safe_direction"),
    ],
    "guides": [
        (anchors.refine_anchors, "M", "x0 goal c directions fine_range anchors"),
        (guides.make_guides, "M", "x0 a0 goal c anchors guide_coefficients guides"),
        (guides.nominal_controls, "M", "x0 goal c guide_coefficients nominal_controls"),
    ],
    "rollouts": [
        (mppi.sample_controls, "M K N", "c nominal_controls noise sample_controls"),
        (dynamics.roll_out, "M K", "x0 c sample_controls sample_states"),
    ],
    "clearance": [
        (costs.clearance, "M K N", "filtered_points sample_states sample_clearance"),
        (mppi.stage1_cost, "M K", "goal c guides sample_controls sample_states sample_clearance stage1_cost"),
    ],
    "update": [
        (mppi.softmin, "M", "c stage1_cost sample_weights"),
        (mppi.update_controls, "M N", "nominal_controls sample_controls sample_weights controls"),
    ],
    "stage2": [
        (dynamics.roll_out, "M 1", "x0 c controls states"),
        (costs.clearance, "M 1 N", "filtered_points states clearance"),
        (selection.stage2_cost, "M", "goal c states clearance goal_cost collision_cost stage2_cost"),
        (selection.select_instance, "1", "stage2_cost best"),
    ],
}
"""Launches of each stage: kernel, symbols of its dimensions, and its arguments by name."""


class ReferencePlanner:
    """The planner of the paper: the plans of `Planner` with the preset "paper", by its equations as they read.

    Args:
        config: parameters of the paper; None for the preset.
        device: "cpu" or a CUDA device such as "cuda:0".

    Attributes:
        arrays: device arrays of the inputs and of every stage.

    Raises:
        ValueError: the device does not exist, or the configuration uses an option that the paper does not have.
    """

    def __init__(self, config: PlannerConfig | None = None, *, device: str = "cpu") -> None:
        config = config or PlannerConfig.preset("paper")
        c, pool = parameters_of(config), config.partition.fine_cells
        self._device = find_device(device)
        C0, C1 = int(partition.COARSE_ROWS), int(partition.COARSE_COLUMNS)
        self._sizes = SimpleNamespace(
            M=config.anchor_count, K=config.sampling.samples, N=config.sampling.steps, P=0,
            F0=C0 * pool, F1=C1 * pool, C0=C0, C1=C1,
        )  # fmt: skip
        self.arrays = allocate(ReferenceArrays, self._sizes, self._device)
        self._problem: dict[str, Any] = {"c": c, "M_h": config.anchors.columns}

    def plan(self, state: VehicleState, goal: Goal, points: ArrayLike, noise: ArrayLike) -> Plan:
        """Plan once.

        Args:
            state: state of the drone, world frame.
            goal: state at the goal, world frame.
            points: the last sweeps [m], shape [P, 3], world frame; those that are not finite are dropped and counted.
            noise: white noise of unit variance, shape [M, K, N, 4].

        Returns:
            The fields that the paper has; the status is OK, since the paper knows no other.

        Raises:
            ValueError: an input has the wrong shape or is not finite.
        """
        values = check_inputs(state, goal, 0.0, None, ())
        cloud, drawn = (np.asarray(array, dtype=np.float32) for array in (points, noise))
        expected = (*self.arrays.noise.shape, 4)
        if cloud.ndim != 2 or cloud.shape[1] != 3:
            raise ValueError(f"points has shape {cloud.shape}; it must have shape (P, 3).")
        if drawn.shape != expected:
            raise ValueError(f"noise has shape {drawn.shape}; it must have shape {expected}: M, K, N and 4 controls.")
        self.arrays.noise.assign(drawn)
        self.arrays.points = wp.array(cloud, dtype=wp.vec3, device=self._device)  # pyright: ignore[reportArgumentType]
        self._sizes.P = len(cloud)
        self._problem["x0"] = _state(values["position"], values["quaternion"], values["velocity"])
        self._problem["a0"] = wp.vec3(*np.nan_to_num(values["acceleration"]))
        self._problem["goal"] = _complete_goal(values)
        for stage in STAGES:
            self.launch(stage)
        return self.result()

    def launch(self, stage: str) -> None:
        """Launch a stage again, for the state and the goal of the last plan, from `arrays` into `arrays`."""
        values = self._problem | as_dict(self.arrays)
        for kernel, dimensions, names in STAGES[stage]:
            dim = [1 if symbol == "1" else getattr(self._sizes, symbol) for symbol in dimensions.split()]
            wp.launch(kernel, dim=dim, inputs=[values[name] for name in names.split()], device=self._device)

    def result(self) -> Plan:
        """Return what `arrays` hold as a plan."""
        a: dict[str, Any] = {name: array.numpy().copy() for name, array in as_dict(self.arrays).items()}
        states, controls, clearance = (a[name][:, 0] for name in ("states", "controls", "clearance"))
        same = (
            "fine_range", "safe_range", "safe_direction", "initial_endpoints", "anchors", "guides", "stage1_cost",
            "stage2_cost", "goal_cost", "collision_cost",
        )  # fmt: skip
        return Plan(
            **{name: a[name] for name in same},
            continued_cells=None,
            filtered_points=a["filtered_points"][np.isfinite(a["filtered_points"]).all(axis=-1)],
            guide_coefficients=np.swapaxes(a["guide_coefficients"], 1, 2),
            kinds=("anchor",) * len(states),
            controls=controls,
            positions=states["p"],
            velocities=states["v"],
            quaternions=states["q"],
            clearance=np.minimum(clearance, self._problem["c"].d_max),
            best=int(a["best"][0]),
            status=PlanStatus.OK,
            dropped_points=int(a["dropped_points"][0]),
            samples=a["sample_states"]["p"],
        )


def _state(p: NDArray[Any], q: NDArray[Any], v: NDArray[Any]) -> Any:
    """Return the state [p, q, v] with q normalised."""
    x: Any = dynamics.State()
    x.p, x.q, x.v = wp.vec3(*p), wp.vec4(*(q / np.linalg.norm(q))), wp.vec3(*v)
    return x


def _complete_goal(values: dict[str, NDArray[Any]]) -> Any:
    """Return the goal [p, q, v], where what is NaN is completed as `Goal` says: at rest, the nose toward the goal."""
    q = values["goal_quaternion"]
    if np.isnan(q).any():
        ahead = values["goal_position"] - values["position"]
        if np.hypot(ahead[0], ahead[1]) <= 0.5:
            ahead = rotate(values["quaternion"], (1.0, 0.0, 0.0))
        heading = np.arctan2(ahead[1], ahead[0])
        q = np.array([np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)])
    return _state(values["goal_position"], q, np.nan_to_num(values["goal_velocity"]))
