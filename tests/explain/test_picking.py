"""Meaning of a click in the scene."""

import dataclasses

import numpy as np
import pytest

from aero_viz.explain.picking import describe_point, pick
from tests.explain.conftest import evidence_of

EYE = np.array([-3.0, -1.0, 4.0])


@pytest.fixture(scope="module")
def frame():
    return evidence_of("double_wall_trap", 36, 12)[0].frame


def toward(place):
    return (place - EYE) / np.linalg.norm(place - EYE)


@pytest.mark.parametrize(("kind", "step"), [("anchor", None), ("rollout", 20), ("guide", 15)])
def test_an_instance_is_picked_by_its_anchor_its_rollout_and_its_guide(frame, kind, step):
    plan, hits = frame.plan, 0
    for m in range(15):
        place = plan.anchors[m] if step is None else (plan.positions if kind == "rollout" else plan.guides)[m, step]
        picked = pick(frame, EYE, toward(place.astype(np.float64)))
        assert picked is not None and picked.instance is not None
        hits += picked.instance == m
    assert hits >= 12, "others may lie in front of it"


def test_a_point_of_the_cloud_tells_its_range_age_sweep_and_cell(frame):
    sweeps = list(frame.observation.sweeps)
    point = sweeps[27][100].astype(np.float64)
    facts = dict(describe_point(frame, point))
    distance = np.linalg.norm(point - frame.observation.state.position)
    assert facts["range"] == f"{distance:.2f} m" and facts["sweep"].startswith("28 of 30")
    assert facts["age"] == f"{frame.time - frame.observation.sweep_times[27]:.2f} s since the end of that sweep"
    assert facts["obstacle"].startswith(("box", "the ground"))
    nearest = float(facts["fine cell"].split()[-2])
    assert nearest <= distance + 0.05


def test_a_point_that_is_too_near_says_that_the_partition_leaves_it_out(frame):
    offset = np.asarray(frame.observation.points) - frame.observation.state.position
    distance = np.linalg.norm(offset, axis=1)
    is_near = (distance > distance.min()) & (distance < distance.min() + 1.0)
    config = frame.config.replace({"partition.range_min": float(min(distance.min() + 1.0, 5.0))})
    open_cells = dataclasses.replace(frame.plan, fine_range=np.full_like(frame.plan.fine_range, 10.0))
    strict = dataclasses.replace(frame, config=config, plan=open_cells)
    points = frame.observation.points[is_near][::20].astype(np.float64)
    partition = [dict(describe_point(strict, point)).get("partition") for point in points]
    assert "left out: nearer than partition.range_min" in partition
    assert not any("partition" in dict(describe_point(frame, point)) for point in points)


def test_a_click_behind_everything_picks_a_point_or_nothing(frame):
    points, plan = frame.observation.points[::500].astype(np.float64), frame.plan
    lines = np.concatenate([plan.anchors, plan.guides.reshape(-1, 3), plan.positions.reshape(-1, 3)])
    sights, others = ((places - EYE) / np.linalg.norm(places - EYE, axis=1)[:, None] for places in (points, lines))
    seen = points[(sights @ others.T).max(axis=1).argmin()]
    picked = pick(frame, EYE, toward(seen))
    assert picked is not None and picked.kind == "point"
    assert np.linalg.norm(np.cross(picked.point - EYE, toward(seen))) < 0.1
    assert pick(frame, EYE, np.array([0.0, 0.0, 1.0])) is None
    cell = pick(frame, EYE, toward(frame.plan.filtered_points[0].astype(np.float64)), cells=True)
    assert cell is not None
