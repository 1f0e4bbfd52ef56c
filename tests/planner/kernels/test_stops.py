"""Proof of stops: on a CPU only those that the selection needs are evaluated."""

import numpy as np
import pytest
import warp as wp

from aero_planner import Planner, PlannerConfig, PlanStatus
from aero_planner.device.kernel_tuning import CPU
from aero_planner.kernels.movers import Movers
from aero_planner.kernels.mppi import PROBES
from aero_planner.device.params import Params
from aero_planner.device.records import DroneState, Rollouts, bundle
from aero_planner.kernels.stop_proof import evaluate_stops
from aero_planner.kernels.stops import STOPS, mover_allowances, roll_out_stops, seen_range
from tests.planner import reference
from tests.planner.cases import config_of, random_case


def clearance_of_all_stops(planner: Planner, config: PlannerConfig) -> np.ndarray:
    """Return the clearance of every stop of the last plan [m], shape [M, STOPS], from the kernels for CUDA."""
    i, o, w, M = planner.inputs, planner.outputs, planner.workspace, len(config.kinds)
    drone = bundle(
        DroneState, position=w.position, velocity=w.velocity, quaternion=w.quaternion, acceleration=w.acceleration,
        disturbance=o.disturbance, drag=o.drag, command=w.command, control=w.control,
    )  # fmt: skip
    rollouts = bundle(
        Rollouts, controls=o.controls, positions=o.positions, velocities=o.velocities, quaternions=o.quaternions
    )
    count, part = M * int(STOPS), config.partition
    rows, columns = part.coarse_rows * part.fine_cells, part.coarse_columns * part.fine_cells
    movers = bundle(
        Movers, count=o.mover_count, position=o.mover_position, velocity=o.mover_velocity, radius=o.mover_radius
    )
    controls, positions, clearance = (wp.empty_like(a) for a in (w.stop_controls, w.stop_positions, w.stop_clearance))
    wp.launch(
        roll_out_stops(CPU), (1, count), inputs=[w.finished, drone, planner.params, w.plan_period, rollouts],
        outputs=[controls, positions, clearance],
    )  # fmt: skip
    wp.launch(
        evaluate_stops(CPU),
        (1, count, 4 * config.sampling.steps, 1),
        inputs=[
            w.finished, i.position, i.quaternion, i.ground_height, movers, planner.params, int(PROBES), 1, rows,
            columns, o.fine_range, o.positions, w.plan_period, w.cell_ends, w.point_packs, positions, w.state_terms,
            w.standing_clearance,
        ],
        outputs=[clearance],
    )  # fmt: skip
    return clearance.numpy().reshape(M, int(STOPS))


@pytest.mark.parametrize("proof", ["instead", "required"])
@pytest.mark.parametrize("prefer_safe", [True, False])
def test_the_selection_is_that_among_all_stops(proof: str, prefer_safe: bool):
    config = config_of(candidates__prove_stop=proof, candidates__prefer_safe=prefer_safe, candidates__brake=False)
    planner, safe_plans, least = Planner(config, threads=1), 0, config.candidates.stop_clearance
    for seed in range(40):
        planner.reset()
        plan = random_case(seed, nearest=0.8 + 0.05 * (seed % 20), tilt=0.3).plan(planner)
        if plan.status != PlanStatus.OK:  # a braking candidate has replaced what the stops belong to
            assert planner.workspace.stop_clearance.numpy().max() < least
            continue
        safe_plans += 1
        clearance, scores = clearance_of_all_stops(planner, config), planner.workspace.instance_scores.numpy()[0]
        is_safe = (clearance >= least).any(axis=1) & ((proof == "instead") | (scores[: len(clearance), 1] >= 0.3))
        among = is_safe if prefer_safe else np.ones_like(is_safe)
        assert plan.best == np.argmin(np.where(among, scores[: len(clearance), 0], np.inf))
        first = int(np.argmax(clearance[plan.best] >= least))
        kept = planner.workspace.stop_clearance.numpy().reshape(clearance.shape)[plan.best]
        assert kept[first] >= least and (kept[:first] < least).all()
    assert safe_plans > 5


def test_the_widest_stop_is_the_widest_of_all():
    """On a CPU the last stops are only evaluated as far as they may be the widest."""
    config = config_of(candidates__brake=False)
    planner, flown = Planner(config, threads=1), 0
    least = config.candidates.stop_clearance
    for seed in range(60):
        planner.reset()
        case = random_case(seed, nearest=0.8 + 0.02 * (seed % 20), tilt=0.3, speed=6.0)
        plan = case.plan(planner)
        if plan.status == PlanStatus.OK or plan.kinds[plan.best] == "brake":
            continue
        flown += 1
        assert plan.braking is not None
        expected = clearance_of_all_stops(planner, config)
        found = planner.workspace.stop_clearance.numpy().reshape(expected.shape)
        assert plan.best == np.argmax(expected.max(axis=1))
        assert found[plan.best].max() == expected.max() < least
        assert (found >= expected).all()
        braking = planner.workspace.instance_scores.numpy()[0, len(config.kinds) : -1]
        assert braking[:, 1].max() < expected.max() and braking[:, 2].max() < least
        planner.reset()
        planner.configure(config.replace({"candidates.widest_stop": False}))
        braked = case.plan(planner)
        planner.configure(config)
        assert braked.status != PlanStatus.OK and braked.kinds[braked.best] == "brake"
    assert flown > 2


@wp.kernel
def seen_kernel(params: wp.array(dtype=Params), fine_range: wp.array2d(dtype=float), out: wp.array2d(dtype=float)):
    i = wp.tid()
    rows, columns = out.shape[0], out.shape[1]
    row, column = i // columns, i % columns
    out[row, column] = seen_range(0, row, column, rows, columns, params[0], fine_range)


@pytest.mark.parametrize("is_closed", [True, False])
def test_holes_of_one_cell_in_a_surface_are_not_seen_through(device: str, is_closed: bool):
    planner = Planner(config_of(candidates__stop_seen_closing=is_closed), device=device)
    r = np.random.default_rng(0).uniform(0.5, 10.0, size=(6, 12)).astype(np.float32)
    r[2:5, 3:8] = 0.8
    r[3, 5] = 10.0
    out = wp.zeros(r.shape, dtype=float, device=device)
    fine_range = wp.array(r.reshape(1, -1), dtype=float, device=device)
    wp.launch(seen_kernel, r.size, inputs=[planner.params, fine_range], outputs=[out], device=device)
    np.testing.assert_array_equal(out.numpy(), reference.closed(r) if is_closed else r)
    assert (out.numpy()[3, 5] == np.float32(0.8)) == is_closed


def test_braking_into_unseen_space_is_not_clear(device: str):
    on, off = (Planner(config_of(candidates__brake_seen=is_on), device=device) for is_on in (True, False))
    M, hidden_guides = len(on.config.kinds), 0
    for seed in range(10):
        case = random_case(seed, nearest=0.8, tilt=0.3, speed=6.0)
        on.reset()
        off.reset()
        plan, _ = case.plan(on), case.plan(off)
        scores, clear = (planner.workspace.instance_scores.numpy()[0] for planner in (on, off))
        offset = on.outputs.positions.numpy()[0, M : M + 5, 1:].astype(np.float64) - case.position
        r = reference.closed(plan.fine_range.astype(np.float64))
        row, column, border = reference.cell_indices(offset @ reference.rotation(case.quaternion), *r.shape)
        distance = np.linalg.norm(offset, axis=-1)
        is_sure = border > 1e-4  # rounding decides on the cells of the others
        is_hidden = ((distance > 0.5) & (distance > r[row, column]) & is_sure).any(axis=1)
        expected = clear.copy()
        expected[M : M + 5, 1:] -= is_hidden[:, None]
        compared = np.append(np.r_[:M, M + 5], M + np.flatnonzero(is_hidden | is_sure.all(axis=1)))
        np.testing.assert_allclose(scores[compared], expected[compared], atol=1e-6)
        hidden_guides += np.count_nonzero(is_hidden)
    assert 5 < hidden_guides < 45


@wp.kernel
def allowance_kernel(starts: wp.array(dtype=wp.vec2), params: wp.array(dtype=Params), out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    safe, stop_safe = mover_allowances(starts[i][0], starts[i][1], params[0])
    out[i] = wp.vec2(safe, stop_safe)


def test_what_moves_near_the_start_may_come_nearer_but_what_stands_may_not(device: str):
    """The starts are clearances with and without what moves: nothing near, a moving obstacle, a static one, both."""
    planner = Planner(config_of(candidates__safe_clearance=0.35, candidates__stop_clearance=0.3), device=device)
    starts = wp.array([(1.0, 1.0), (0.1, 1.0), (0.1, 0.1), (0.1, 0.32)], dtype=wp.vec2, device=device)
    out = wp.zeros_like(starts)
    wp.launch(allowance_kernel, 4, inputs=[starts, planner.params], outputs=[out], device=device)
    expected = [(0.0, 0.0), (0.35 - 0.08, 0.3 - 0.095), (0.0, 0.0), (0.3 - 0.08, 0.3 - 0.095)]
    np.testing.assert_allclose(out.numpy(), expected, atol=1e-6)
