"""AERO-MPPI with one instance."""

from small_source import small_source

from aero_viz.planners import load
from aero_viz.session import Session


def test_one_instance_plans_and_the_presets_keep_it_single():
    kind = load("single_mppi").Config
    assert all(kind.preset(name).kinds == ("anchor",) for name in kind.presets())  # type: ignore[attr-defined]
    session = Session(small_source(), config=kind().replace({"sampling.samples": 16}))
    frame = session.tick()
    assert frame.plan.kinds == ("anchor",) and "samples" in frame.plan.extensions
    session.close()
