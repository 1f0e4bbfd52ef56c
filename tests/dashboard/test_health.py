"""The health of the planner: what is not healthy gets better by the advice."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from ensemble_plans import plan_of
from small_source import small_config, small_source
from straight import StraightConfig

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig
from aero_viz.catalog import open_source
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.health import readings
from aero_viz.dashboard.panels.health import HealthPanel
from aero_viz.dashboard.signals import effective_samples
from aero_viz.planners import CandidatePlan, load
from aero_viz.planners.single_mppi import SingleMppiConfig
from aero_viz.session import Frame, Session


def flown(changes: Mapping[str, Any], ticks: int = 25) -> list[Frame]:
    session = Session(open_source("forest", seed=0), config=PlannerConfig().replace(changes))
    session.judge_candidates().result()
    frames = [session.tick() for _ in range(ticks)]
    session.close()
    return frames


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return flown({})


def reading(frames: list[Frame], label: str):
    return next(found for found in readings(frames) if found.label == label)


@pytest.mark.parametrize("asked", [0.0, 12.0])
def test_a_low_temperature_takes_the_best_sample_alone_and_the_advice_mends_it(asked: float):
    changes = {"sampling.temperature": 0.003, "sampling.effective_samples": asked}
    frames = flown(changes)
    before = reading(frames[-10:], "effective samples")
    assert not before.is_healthy and before.advice is not None and "raise the temperature" in before.meaning
    assert float(before.value.split()[0]) < 2.0 and before.advice.path == "sampling.temperature"
    after = flown(changes | {"sampling.temperature": before.advice.value})
    assert effective_samples(plan_of(after[-1]), plan_of(after[-1]).best) > 1.5


def test_the_default_averages(frames):
    found = reading(frames[-10:], "effective samples")
    assert found.is_healthy and 2.0 < float(found.value.split()[0]) <= 12.5


def test_the_figures_are_those_of_the_plans(frames):
    found, plans = {r.label: r for r in readings(frames)}, [plan_of(frame) for frame in frames]
    config = frames[-1].config
    safe = np.mean([frame.is_safe.mean() for frame in frames if frame.is_safe is not None])
    assert found["safe candidates"].value == f"{safe:.0%}"
    v = config.vehicle
    high = np.array([v.thrust_max, v.rate_xy_max, v.rate_xy_max, v.rate_z_max])
    low = np.array([v.thrust_min, *-high[1:]])
    at = [np.isclose(p.controls, low, atol=1e-3) | np.isclose(p.controls, high, atol=1e-3) for p in plans]
    assert found["controls at bounds"].value == f"{np.mean(at):.0%}"
    gaps = [np.linalg.norm(p.positions[:15] - p.guides[:15], axis=-1).mean() for p in plans]
    assert found["distance from guides"].value == f"{np.mean(gaps):.2f} m"
    times = [p.stage_ms["total"] for p in plans]
    assert found["plan time"].value == f"{np.median(times):.1f} of 20 ms"


@pytest.mark.parametrize(
    ("changes", "label", "path"),
    [
        (
            {"candidates.safe_clearance": 5.0, "stop_proof.stop_clearance": 5.0},
            "safe candidates",
            "vehicle.speed_limit",
        ),
        ({"sampling.variance_rate_xy": 90.0}, "samples at bounds", "sampling.variance_rate_xy"),
        (
            {"costs.q_track": 0.0, "costs.q_speed": 0.0, "costs.q_position": 900.0},
            "distance from guides",
            "costs.q_track",
        ),
    ],
)
def test_what_is_wrong_is_found_and_has_something_to_try(changes, label: str, path: str):
    found = reading(flown(changes, 40)[-5:], label)
    assert not found.is_healthy and found.advice is not None and found.advice.path == path


def test_a_plan_that_takes_longer_than_its_period_asks_for_fewer_samples(frames):
    slow = [dataclasses.replace(frame, timings_ms={"plan": 45.0}) for frame in frames]
    found = reading(slow, "plan time")
    assert found.value == "45.0 of 20 ms" and found.advice is not None
    assert (found.advice.path, found.advice.value) == ("sampling.samples", 128)


def flown_by(config: DroneConfig, ticks: int = 4) -> list[Frame]:
    session = Session(small_source(), config=config)
    session.judge_candidates().result()
    frames = [session.tick() for _ in range(ticks)]
    session.close()
    return frames


def with_plans(frames: list[Frame], **changes: Any) -> list[Frame]:
    """Return frames of another planner with other plans."""

    def changed(plan: object) -> CandidatePlan:
        assert isinstance(plan, CandidatePlan)
        return dataclasses.replace(plan, **changes)

    return [dataclasses.replace(frame, plan=changed(frame.plan)) for frame in frames]


@pytest.mark.parametrize("config", [StraightConfig(), load("primitives").Config()], ids=["straight", "primitives"])
def test_of_another_planner_the_figures_are_those_that_hold_for_every_plan(config: DroneConfig):
    frames = flown_by(config)
    assert [r.label for r in readings(frames)] == ["spread of costs", "safe candidates", "plan time"]
    safe = [frame.is_safe for frame in frames if frame.is_safe is not None]
    assert len(safe) == len(frames) and reading(frames, "safe candidates").value == f"{np.mean(safe):.0%}"
    costs = [frame.plan.cost[good] for frame, good in zip(frames, safe, strict=True)]
    spread = np.mean([(np.median(cost) - cost.min()) / max(cost.min(), 1.0) for cost in costs])
    assert reading(frames, "spread of costs").value == f"{spread:.1%}"
    slow = reading([dataclasses.replace(frame, timings_ms={"plan": 45.0}) for frame in frames], "plan time")
    assert not slow.is_healthy and slow.advice is None and slow.meaning.endswith("for its period.")
    unsafe = [dataclasses.replace(frame, is_safe=np.zeros(len(frame.plan.kinds), dtype=np.bool_)) for frame in frames]
    advice = reading(unsafe, "safe candidates").advice
    assert advice is not None and config.replace({advice.path: advice.value}) != config
    assert advice.text(config).startswith("Speed limit [m/s]: ")


def test_what_is_unknown_or_no_choice_is_no_figure():
    frames = flown_by(StraightConfig())
    shut = with_plans(frames, costs={"goal": np.array([2.0, 2.0])}, is_safe=None)
    unknown = [dataclasses.replace(frame, is_safe=None) for frame in shut]
    assert reading(unknown, "safe candidates").value == "at most 100%"
    assert reading(unknown, "spread of costs").value == "0.0%"
    labels = [r.label for r in readings(flown_by(SingleMppiConfig()))]
    assert "effective samples" in labels and "spread of S2" not in labels, "one candidate is no choice"


def test_the_page_shows_the_health_of_another_planner_also_after_that_of_aero_mppi():
    session = Session(small_source())
    dashboard = Dashboard(session, port=0)
    try:
        (panel,) = (panel for panel in dashboard.panels if isinstance(panel, HealthPanel))
        for config, has_samples in ((small_config(), True), (load("primitives").Config(), False)):
            changes = []
            for frame in flown_by(config):
                unsafe = np.zeros(len(frame.plan.kinds), dtype=np.bool_)
                changes = panel.update(dataclasses.replace(frame, is_safe=unsafe))
            texts = " ".join(str(value) for _, name, value in changes if name == "content")
            assert "safe candidates" in texts and "plan time" in texts
            assert ("effective samples" in texts) == has_samples
            labels = [str(value) for _, name, value in changes if name == "label"]
            assert any(label.startswith("Try Speed limit") for label in labels)
    finally:
        dashboard.close()
        session.close()
