"""Contents of the trace of a flight."""

import dataclasses

import numpy as np
from ensemble_plans import plan_of

from aero_viz.explain.evidence import Replanner
from aero_viz.explain.trace import KEPT, FlightTrace
from tests.explain.conftest import evidence_of


def test_a_trace_keeps_the_end_without_samples_and_joined_clouds(replan: Replanner):
    trace, frame = FlightTrace(), evidence_of("double_wall_trap", 36, 12)[0].frame
    cloud = frame.observation.points
    sampled = dataclasses.replace(frame, plan=dataclasses.replace(plan_of(frame), samples=np.zeros((17, 128, 26, 3))))
    for tick in range(500):
        trace.write(dataclasses.replace(sampled, time=0.02 * tick))
    assert plan_of(trace.last).samples is None and trace.last.time - trace.frames[0].time <= KEPT
    assert "points" not in vars(trace.last.observation.sweeps)
    np.testing.assert_array_equal(trace.last.observation.points, cloud)
    assert replan(trace.frames[0]).is_exact
    trace.write(dataclasses.replace(frame, time=5.0))
    assert trace.last.time == 5.0 and len(trace.frames) < 100, "a tick that is planned again replaces the later ones"
