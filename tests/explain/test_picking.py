"""Meaning of a click in the scene."""

import numpy as np
import pytest

from aero_planner import PlannerConfig
from aero_viz.explain.picking import describe_point, pick
from aero_viz.flight import FlightSource
from aero_viz.scenes import scene
from aero_viz.session import Session
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


@pytest.fixture(scope="module")
def among_pillars():
    """A frame of a slow flight among pillars, all of which move."""
    session = Session(
        FlightSource(scene("moving", count=60, seed=1)), config=PlannerConfig().replace({"vehicle.speed_limit": 1.0})
    )
    frames = [session.tick() for _ in range(60)]
    session.close()
    return frames[-1]


def test_a_point_that_an_obstacle_has_left_says_so(among_pillars):
    sweeps = list(among_pillars.observation.sweeps)

    def left_out(points):
        facts = [dict(describe_point(among_pillars, point.astype(np.float64))) for point in points]
        return [point for point, fact in zip(points, facts, strict=True) if "moved on" in fact.get("partition", "")]

    old = sweeps[-7]
    near = old[(np.linalg.norm(old - among_pillars.observation.state.position, axis=1) < 8.0) & (old[:, 2] > 0.5)]
    gone = left_out(near[:: max(len(near) // 200, 1)])
    world = among_pillars.world
    assert len(gone) > 5
    assert np.median(world.distance(np.array(gone))) > 0.2, "nothing stands there any more"
    assert len(left_out(sweeps[-1][::100])) == 0


def test_a_click_behind_everything_picks_a_point_or_nothing(frame):
    low = frame.observation.points[frame.observation.points[:, 0] < -0.9].astype(np.float64)[-1]
    picked = pick(frame, EYE, toward(low))
    assert picked is not None and picked.kind == "point"
    assert np.linalg.norm(np.cross(picked.point - EYE, toward(low))) < 0.1
    assert pick(frame, EYE, np.array([0.0, 0.0, 1.0])) is None
    cell = pick(frame, EYE, toward(frame.plan.filtered_points[0].astype(np.float64)), cells=True)
    assert cell is not None
