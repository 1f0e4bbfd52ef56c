import functools
from collections.abc import Iterator

import pytest
from ensemble_plans import full

from aero_planner import PlannerConfig
from aero_viz.catalog import open_source
from aero_viz.explain.evidence import Evidence, Replanner
from aero_viz.session import Session

OPEN_ABOVE = PlannerConfig().replace(
    {"unseen_space.continuation": 0.0, "unseen_space.view_age": 0.0, "costs.height_max": 99.0}
)
"""A planner that takes what it does not see above for free, and hits ceilings."""


@pytest.fixture(scope="session")
def replan() -> Iterator[Replanner]:
    replanner = Replanner()
    yield replanner
    replanner.close()


@functools.cache
def evidence_of(scene: str, ticks: int, every: int, preset: str = "default") -> tuple[Evidence, ...]:
    """Return the evidence of every n-th plan of the beginning of a flight."""
    session, replanner = (
        Session(open_source(scene, seed=0), config=OPEN_ABOVE if preset == "default" else PlannerConfig.preset(preset)),
        Replanner(),
    )
    frames = [session.tick() for _ in range(ticks)][every - 1 :: every]
    session.close()
    evidence = tuple(full(replanner(frame)) for frame in frames)
    replanner.close()
    return evidence
