"""What the page says of a configuration, without a browser."""

from __future__ import annotations

import re

from aero_planner import PlannerConfig
from aero_viz.dashboard.panels.configuration import differences


def test_differences_show_old_and_new_value_and_the_flags():
    config = PlannerConfig().replace({"costs.q_track": 7.5, "candidates.brake": False})
    html = differences(config)
    text = re.sub("<[^>]*>", " ", html)
    assert "5.0 → 7.5" in text and "True → False" in text
    assert "--costs.q-track 7.5" in text and "--candidates.brake False" in text


def test_the_default_differs_in_nothing():
    assert differences(PlannerConfig()) == ""
