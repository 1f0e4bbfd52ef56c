import time

import pytest

from aero_planner import PlannerConfig
from aero_viz.session.config_history import ConfigHistory


def test_changes_are_undone_and_redone():
    history = ConfigHistory(PlannerConfig())
    history.change({"costs.q_track": 1.0})
    history.change({"costs.q_track": 2.0, "costs.q_position": 4.0})
    assert history.go(-1).costs.q_track == 1.0
    assert history.go(-1) == PlannerConfig()
    assert history.go(-1) == PlannerConfig()
    assert history.go(+1).costs.q_track == 1.0
    assert history.go(+1).costs.q_position == 4.0


def test_a_change_after_undo_discards_what_was_undone():
    history = ConfigHistory(PlannerConfig())
    history.change({"costs.q_track": 1.0})
    history.go(-1)
    history.change({"costs.q_track": 2.0})
    assert history.go(+1).costs.q_track == 2.0


def test_a_refused_change_leaves_the_configuration():
    history = ConfigHistory(PlannerConfig())
    with pytest.raises(ValueError, match=r"costs\.q_track is -1"):
        history.change({"costs.q_track": -1.0})
    assert history.current == (PlannerConfig(), 0)


def test_dragging_a_slider_is_one_step_of_undo(monkeypatch: pytest.MonkeyPatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    history = ConfigHistory(PlannerConfig())
    for value in (6.0, 7.0, 8.0):
        now[0] += 0.1
        history.change({"costs.q_track": value})
    now[0] += 5.0
    history.change({"costs.q_track": 2.0})
    assert history.current[1] == 4
    assert history.go(-1).costs.q_track == 8.0
    assert history.go(-1) == PlannerConfig()


FAILED = {"sampling.samples": 2000}


def test_a_failed_configuration_is_dropped_and_undo_skips_it():
    history = ConfigHistory(PlannerConfig())
    good = history.change({"costs.q_track": 1.0})
    version = history.current[1]
    history.drop(history.change(FAILED), good)
    assert history.current[0] == good and history.current[1] > version
    assert history.go(+1) == good
    assert history.go(-1) == PlannerConfig()


def test_a_configuration_that_fails_on_undo_is_dropped_too():
    history = ConfigHistory(PlannerConfig())
    history.change(FAILED)
    good = history.change({"sampling.samples": 8, "costs.q_track": 1.0})
    history.drop(history.go(-1), good)
    assert history.current[0] == good
    assert history.go(-1) == PlannerConfig()


def test_a_slider_dragged_to_a_failing_value_returns_to_the_last_good_one():
    history = ConfigHistory(PlannerConfig())
    good = history.change({"sampling.samples": 8})
    history.drop(history.change(FAILED), good)  # within the same second: one step of undo
    assert history.current[0] == good
    assert history.go(-1) == PlannerConfig()


def test_a_change_made_while_another_fails_stays():
    history = ConfigHistory(PlannerConfig())
    failed = history.change(FAILED)
    newer = history.change({"sampling.samples": 8, "costs.q_track": 1.0})
    history.drop(failed, PlannerConfig())
    assert history.current[0] == newer
    assert history.go(-1) == PlannerConfig()


def test_an_equal_configuration_does_not_count_as_a_change():
    history = ConfigHistory(PlannerConfig())
    history.change(PlannerConfig())
    assert history.current[1] == 0


def test_the_oldest_of_many_configurations_are_forgotten():
    history = ConfigHistory(PlannerConfig())
    for k in range(1200):
        history.change({("costs.q_track", "costs.q_position")[k % 2]: 1.0 + 0.001 * k})
    steps = [history.go(-1) for _ in range(1200)]
    assert steps[0].costs.q_position != steps[1].costs.q_position or steps[0].costs.q_track != steps[1].costs.q_track
    assert steps[498] == steps[-1] != PlannerConfig() and steps[497] != steps[498]
    assert history.go(+1) == steps[497]


def test_a_conversion_holds_for_every_configuration_and_is_no_step_of_undo():
    history = ConfigHistory(PlannerConfig().replace({"costs.height_max": 9.0}))
    history.change({"costs.q_track": 1.0})
    refused = history.change({"costs.height_min": 4.0})  # above the new greatest height
    history.go(-1)
    version = history.current[1]
    with history.converted(lambda config: config.replace({"costs.height_max": 3.0})):
        pass
    assert history.current == (PlannerConfig().replace({"costs.height_max": 3.0, "costs.q_track": 1.0}), version + 1)
    assert history.go(-1) == PlannerConfig().replace({"costs.height_max": 3.0})
    history.go(+1)
    assert history.go(+1) == refused


def test_a_conversion_whose_context_fails_leaves_no_trace():
    history = ConfigHistory(PlannerConfig())
    changed = history.change({"costs.q_track": 1.0})
    with (
        pytest.raises(RuntimeError),
        history.converted(lambda config: config.replace({"costs.height_max": 3.0})),
    ):
        assert history.current[0].costs.height_max == 3.0
        raise RuntimeError
    assert history.current[0] == changed and history.go(-1) == PlannerConfig()
