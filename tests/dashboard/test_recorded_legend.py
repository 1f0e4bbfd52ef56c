"""The legend of a shared flight, without a browser."""

import copy
import dataclasses

import numpy as np
from small_source import small_config, small_source

from aero_planner.plan import MovingObstacles
from aero_viz.cost_text import cost_text
from aero_viz.dashboard.layers import ColorKey
from aero_viz.dashboard.layers.goal import GoalLayer
from aero_viz.dashboard.layers.motion import MotionLayer
from aero_viz.dashboard.layers.rollouts import RolloutLayer
from aero_viz.dashboard.share.legend import RecordedLegend
from aero_viz.session import Session
from aero_viz.session.frame import Frame


def with_moving_obstacles(frame: Frame, count: int) -> Frame:
    zeros = np.zeros((count, 2), np.float32)
    plan = copy.copy(frame.plan)
    plan.__dict__["moving"] = MovingObstacles(zeros, zeros, zeros[:, 0])
    return dataclasses.replace(frame, plan=plan)


def test_a_recorded_legend_names_what_is_drawn_at_any_tick_and_has_the_costs_of_each(server):
    session = Session(small_source(), config=small_config())
    frames = [with_moving_obstacles(session.tick(), count) for count in (0, 2, 0)]
    session.close()
    legend, layers = RecordedLegend(), [RolloutLayer(server), MotionLayer(server), GoalLayer(server)]
    for frame in frames:
        legend.add(layers, frame)
    labels = [entry.label for entry in legend.entries if isinstance(entry, ColorKey)]
    assert labels == ["chosen rollout", "dynamic obstacles, predicted", "goal"]
    costs = [frame.plan.cost for frame in frames]
    assert legend.ends == [[(f"worst: {cost_text(cost.max())}", f"best: {cost_text(cost.min())}")] for cost in costs]
