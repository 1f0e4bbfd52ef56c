"""The costs of rollouts term by term, as the planner itself computes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from aero_planner.costs.cost_term import CostTerm
from aero_planner.device.records import bundle
from aero_planner.kernels.terms import TermValues, write_terms
from aero_planner.recorder import Recorder

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class CostTerms:
    """Terms of n rollouts at each of N steps. Terminal terms count at the last step."""

    terms: tuple[CostTerm, ...]
    """The T terms: names, labels, and whether each is a part of S1 and of S2."""
    values: Array
    """Shape [n, T, N]."""
    positions: Array
    """States after each control [m], shape [n, N, 3], world frame."""
    clearance: Array
    """Distance to the nearest obstacle after each control [m], shape [n, N], truncated where it costs nothing."""

    def of_stage1(self) -> CostTerms:
        """Return the same without the terms that are not a part of S1."""
        return self._chosen([i for i, term in enumerate(self.terms) if term.in_stage1])

    def of_stage2(self) -> CostTerms:
        """Return the same without the terms that are not a part of S2."""
        return self._chosen([i for i, term in enumerate(self.terms) if term.in_stage2])

    def _chosen(self, rows: list[int]) -> CostTerms:
        terms = tuple(self.terms[i] for i in rows)
        return CostTerms(terms, self.values[:, rows], self.positions, self.clearance)

    def values_of(self, name: str) -> Array:
        """Return a term at each step, shape [n, N]; zeros if there is none of this name."""
        names = [term.name for term in self.terms]
        return self.values[:, names.index(name)] if name in names else np.zeros_like(self.clearance)

    @property
    def stage1_cost(self) -> Array:
        """S1, shape [n]."""
        return self.values[:, [term.in_stage1 for term in self.terms]].sum(axis=(1, 2))

    @property
    def stage2_cost(self) -> Array:
        """S2, shape [n]."""
        return self.values[:, [term.in_stage2 for term in self.terms]].sum(axis=(1, 2))


def evaluate_terms(recorder: Recorder, instances: Sequence[int], samples: Sequence[tuple[int, int]]) -> CostTerms:
    """Return the terms of rollouts of the first drone's last plan; see `Planner.cost_terms`."""
    r, M, K = recorder, recorder.sizes.M, recorder.sizes.K
    for m, k in (*((m, 0) for m in instances), *samples):
        if not (0 <= m < M and 0 <= k < K):
            raise ValueError(f"there is no sample {k} of instance {m}; a plan has {M} instances of {K} samples.")
    o = r.outputs
    optimised, replaced, flown = (array.numpy()[0] for array in (o.controls, o.braking_instance, o.flown))
    sampled: Any = r.work.sample_controls.numpy() if samples else None
    flown_rows = [int(flown) if m == replaced else m for m in instances]
    controls = [optimised[m] for m in flown_rows] + [sampled[m, :, :, k] for m, k in samples]
    return evaluate_controls(r, [(0, m) for m in (*flown_rows, *(m for m, _ in samples))], controls)


def evaluate_controls(recorder: Recorder, rows: Sequence[tuple[int, int]], controls: ArrayLike) -> CostTerms:
    """Return the terms of rollouts from the start of the last plan.

    Args:
        recorder: arrays of the planner.
        rows: drone, and instance whose guide is tracked, of each.
        controls: their controls, shape [n, N, 4].
    """
    r, device, count = recorder, recorder.params.device, len(rows)
    steps, terms = r.sizes.N, r.composition.terms
    with wp.ScopedDevice(device):
        # A launch of size 0 is no launch, and an array of size 0 has no memory.
        rows_array = wp.array(np.array(rows or [(0, 0)], dtype=np.int32), dtype=wp.vec2i)
        controls_array = wp.array(
            np.array(controls if count else [np.zeros((steps, 4))], dtype=np.float32), dtype=wp.vec4
        )
        values = bundle(
            TermValues,
            values=wp.zeros((max(count, 1), steps, len(terms)), dtype=wp.float32),
            positions=wp.zeros((max(count, 1), steps), dtype=wp.vec3),
            clearance=wp.zeros((max(count, 1), steps), dtype=wp.float32),
        )
        wp.launch(
            write_terms(r.tuning, r.composition),
            count,
            inputs=[
                r.problem, r.start, r.params, r.config.previous_index, r.grid, r.views, r.outputs.guides, rows_array,
                controls_array,
            ],
            outputs=[values],
        )  # fmt: skip
    return CostTerms(
        terms,
        np.moveaxis(values.values.numpy(), 2, 1)[:count],
        values.positions.numpy()[:count],
        values.clearance.numpy()[:count],
    )
