"""Every number of the cards, the bars, the figures, the curves and the reports is that of planner and simulator."""

import dataclasses
import re
from collections.abc import Iterator
from html import unescape
from typing import Any

import numpy as np
import pytest
from ensemble_plans import full, plan_of
from small_source import small_source

from aero_planner import PlannerConfig, PlanStatus
from aero_viz.catalog import open_source, shipped_recordings
from aero_viz.cost_text import cost_text
from aero_viz.dashboard import Dashboard
from aero_viz.dashboard.panels.status import StatusPanel
from aero_viz.dashboard.panels.why_card import card, chart
from aero_viz.explain.evidence import Evidence, Replanner
from aero_viz.explain.post_mortem import explain_flight
from aero_viz.explain.trace import FlightTrace
from aero_viz.explain.verdict import verdict
from aero_viz.flight import FlightSource, StateNoise, VehicleModel
from aero_viz.flight.known_drone import config_for_flight
from aero_viz.scenes import scene
from aero_viz.sensors import LIDARS
from aero_viz.session import Frame, Session
from tests.dashboard.page_client import wait_for

LAGS = {"thrust_lag": 0.04, "rate_lag": 0.07}
CONDITIONS: dict[str, dict[str, Any]] = {
    "noise": {"noise": StateNoise(position=0.1, velocity=0.2, attitude=1.0)},
    "latency": {"drone": {"latency": 0.1}},
    "lags": {"drone": LAGS},
    "drag": {"drone": {"drag": 0.4}},
    "gusts": {"drone": {"drag": 0.4, "gust_speed": 3.0}, "ticks": 60},
    "moving": {"scene": "moving", "ticks": 110},
    "dropout": {"lidar": dataclasses.replace(LIDARS["mid360"], dropout=0.4)},
    "px4": {"preset": "px4", "drone": LAGS},
    "paper": {"preset": "paper"},
    "recording": {"recording": "room_mid360", "ticks": 8},
}


def open_session(condition: dict[str, Any]) -> tuple[Session, FlightSource | None]:
    """Return a session under one of the conditions, and its simulated flight."""
    config = PlannerConfig.preset(condition.get("preset", "default")).replace({"sampling.samples": 64})
    if "recording" in condition:
        path, _ = shipped_recordings()[condition["recording"]]
        return Session(open_source(str(path)), config=config), None
    source = FlightSource(
        scene(condition.get("scene", "forest"), seed=3),
        vehicle=VehicleModel.from_config(config, **condition.get("drone", {})),
        noise=condition.get("noise"),
        lidar=condition.get("lidar"),
        seed=3,
    )
    return Session(source, config=config_for_flight(config, source.info), seed=3), source


@pytest.fixture(scope="module")
def page() -> Iterator[Dashboard]:
    session = Session(small_source())
    session.tick()
    dashboard = Dashboard(session, port=0)
    wait_for(lambda: len(dashboard.history.past().rows), "the session's frame in the history")
    yield dashboard
    dashboard.close()
    session.close()


@pytest.mark.parametrize("name", CONDITIONS)
def test_every_number_is_that_of_planner_and_simulator(name: str, page: Dashboard):
    condition = CONDITIONS[name]
    session, source = open_session(condition)
    session.judge_candidates().result()
    frames = [session.tick() for _ in range(condition.get("ticks", 30))]
    replan, trace = Replanner(), FlightTrace()
    evidence = full(replan(frames[-1]))
    check_evidence(evidence)
    for m in range(len(evidence.plan.kinds)):
        check_card(evidence, m)
        check_sentence(evidence, m)
    check_bars(evidence)
    truth = truth_of(frames[-1], source)
    check_figures(page, frames[-1], truth)
    check_curves(page, frames[-1], truth)
    trace.frames.extend(frames)
    trace.outcome = "timeout"
    check_report(trace, evidence, truth)
    replan.close()
    session.close()
    if name == "moving":
        check_that_motion_counts(evidence)
    if name in ("drag", "gusts"):
        assert evidence.plan.drag is not None and evidence.plan.disturbance is not None
        assert evidence.plan.drag > 0.05 and np.linalg.norm(evidence.plan.disturbance) > 0.01


def truth_of(frame: Frame, source: FlightSource | None) -> dict[str, float]:
    """Return what the simulator says of the drone, or the recording."""
    position, velocity = (np.asarray(x) for x in (frame.observation.state.position, frame.observation.state.velocity))
    if source is not None:
        vehicle = source.simulator.vehicle
        position, velocity = vehicle.position.numpy()[0].astype(np.float64), vehicle.velocity.numpy()[0]
    world = frame.source.world
    assert world is not None
    clearance = world.distance(position[None], np.array([frame.time]))[0]
    goal = np.asarray(frame.observation.goal.position)
    return {
        "speed": float(np.linalg.norm(velocity)),
        "z": float(position[2]),
        "clearance": min(float(clearance), 3.0),
        "goal": float(np.linalg.norm(goal - position)),
    }


def check_evidence(evidence: Evidence) -> None:
    plan, frame, costs = evidence.plan, evidence.frame, evidence.frame.config.costs
    assert evidence.is_exact
    np.testing.assert_allclose(evidence.stage2.stage2_cost, plan.stage2_cost, rtol=1e-4, atol=0.01)
    np.testing.assert_allclose(evidence.stage1.stage1_cost, plan.stage1_cost.min(axis=1), rtol=1e-4, atol=0.01)
    # The distance without an upper end is the planner's clearance up to where that is truncated.
    reach = np.maximum(plan.clearance.max(), costs.distance_max - 1e-3)
    np.testing.assert_allclose(np.minimum(evidence.distance, reach), np.minimum(plan.clearance, reach), atol=2e-3)
    excess = plan.stage1_cost - plan.stage1_cost.min(axis=1, keepdims=True)
    assert plan.temperature is not None
    weights = np.exp(-excess.astype(np.float64) / plan.temperature[:, None])
    weights /= weights.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(evidence.weights, weights, atol=2e-3)
    np.testing.assert_array_equal(frame.is_safe, evidence.is_safe)
    if plan.status == PlanStatus.OK and frame.config.candidates.prefer_safe:
        assert plan.best == np.where(evidence.is_safe, plan.stage2_cost, np.inf).argmin()


def check_that_motion_counts(evidence: Evidence) -> None:
    """Check that a dynamic obstacle is nearer than all others to a part of a rollout, which else tests nothing."""
    moving, plan = evidence.plan.moving, evidence.plan
    assert moving is not None and len(moving.radii)
    static = evidence.obstacles.distance(plan.positions[:, 1:].astype(np.float64))
    reach = evidence.frame.config.costs.distance_max  # where a clearance is truncated
    near = (plan.clearance < np.minimum(static, reach) - 0.05) & (plan.clearance > 0.05)
    assert near.any() and np.linalg.norm(moving.velocities, axis=1).max() > 0.3
    m, step = (int(i[0]) for i in np.nonzero(near))
    position, time = plan.positions[m, step + 1].astype(np.float64), float(evidence.times[step])
    gaps = np.linalg.norm(moving.positions + time * moving.velocities - position[:2], axis=1) - moving.radii
    speed = evidence.obstacles.speed_of_nearest(position, time)
    assert speed == pytest.approx(np.linalg.norm(moving.velocities[gaps.argmin()]))


def check_card(evidence: Evidence, m: int) -> None:
    plan, shown = evidence.plan, unescape(re.sub("<[^>]*>", " ", card(evidence, m)))
    first, second = (float(x) for x in re.findall(r"\ball +([-\d.]+) +([-\d.]+)", shown)[0])
    assert first == pytest.approx(plan.stage1_cost[m].min(), rel=1e-3)
    assert second == pytest.approx(plan.stage2_cost[m], rel=1e-3)
    assert "e-0" not in shown and "e+0" not in shown
    least, time = (float(x) for x in re.findall(r"least ([\d.]+) at ([\d.]+) s", shown)[0])
    known = plan.clearance[m]
    if least < evidence.frame.config.costs.distance_max - 0.01:
        assert least == pytest.approx(known.min(), abs=0.006)
        assert known[round(time / evidence.frame.config.sampling.dt) - 1] == pytest.approx(least, abs=0.006)
    else:
        assert known.min() >= evidence.frame.config.costs.distance_max - 0.02
    effective, count = re.findall(r"effective samples +([\d.]+) of (\d+)", shown)[0]
    assert float(effective) == pytest.approx(1.0 / (evidence.weights[m] ** 2).sum(), abs=0.06)
    assert int(count) == plan.stage1_cost.shape[1]


def check_sentence(evidence: Evidence, m: int) -> None:
    plan, sentence, best = evidence.plan, verdict(evidence, m), int(evidence.plan.best)
    gap = float(plan.stage2_cost[m] - plan.stage2_cost[best])
    if found := re.search(r"It costs ([\d.]+) (more|less) than", sentence):
        assert found[1] == cost_text(abs(gap)) and found[2] == ("more" if gap > 0.0 else "less")
    if found := re.search(r"([\d.]+) more in all", sentence):
        assert m == best or float(found[1]) == pytest.approx(gap, rel=2e-3, abs=0.5)
    if found := re.search(r"it comes within ([\d.]+) m of .* at ([\d.]+) s", sentence):
        step = round(float(found[2]) / evidence.frame.config.sampling.dt) - 1
        assert float(found[1]) == pytest.approx(plan.clearance[m, step], abs=0.006)


def check_bars(evidence: Evidence) -> None:
    plan, titles = evidence.plan, re.findall(r'data-instance="(\d+)" title="([^"]*)"', chart(evidence, None))
    assert len(titles) == len(plan.kinds)
    for m, title in titles:
        assert f"{m} {plan.kinds[int(m)]}: S2 {cost_text(plan.stage2_cost[int(m)])}" in unescape(title)
        terms = [float(value) for value in re.findall(r" ([-\d.]+)(?:,|$)", title.partition(", ")[2])]
        assert sum(terms) == pytest.approx(plan.stage2_cost[int(m)], rel=2e-3, abs=0.5)


def content_of(page: Dashboard, kind: type, frame: Frame) -> str:
    (panel,) = (panel for panel in page.panels if isinstance(panel, kind))
    return "".join(str(content) for _, _, content in panel.update(frame))


def check_figures(page: Dashboard, frame: Frame, truth: dict[str, float]) -> None:
    content, plan, best = content_of(page, StatusPanel, frame), plan_of(frame), int(frame.plan.best)
    shown = re.sub(" +", " ", unescape(re.sub("<[^>]*>", " ", content)))

    def figure(label: str) -> float:
        return float(re.findall(rf"\b{label} ≥?([-\d.]+)", shown)[0])

    if (recorded := frame.recorded_plan) is not None:
        said = re.findall(
            r"recorded plan: instance (\d+) \(\w+\), S2 ([\d.]+), clearance of the plan ([\d.]+) m", shown
        )
        assert said == [
            (
                f"{recorded.best}",
                cost_text(recorded.stage2_cost[recorded.best]),
                f"{recorded.clearance[recorded.best]:.2f}",
            )
        ]
        shown = shown.partition("live planner on this cloud")[2]
    ground = frame.observation.ground_height
    height = "z from first pose" if ground is None else "height"
    assert figure("speed") == pytest.approx(truth["speed"], abs=0.051)
    assert figure(height) == pytest.approx(truth["z"] - (ground or 0.0), abs=0.051)
    assert figure("distance to goal") == pytest.approx(truth["goal"], abs=0.051)
    assert figure("clearance of the plan") == pytest.approx(plan.clearance[best].min(), abs=0.006)
    continued = 0 if plan.continued_cells is None else np.count_nonzero(plan.continued_cells)
    assert figure("filtered points") == len(plan.filtered_points) - continued
    times = re.findall(r"\bplan ([\d.]+) ms", shown)
    assert len(times) == 2 and set(times) == {f"{plan.stage_ms['total']:.1f}"}, "one time of the plan"
    bars = re.findall(
        r'title="(\d+) [\w-]+: S2 ([\d.]+) = goal ([\d.]+) \+ collision ([\d.]+) \+ other terms ([-\d.]+); '
        r"clearance of the plan ([\d.]+) m",
        content,
    )
    assert len(bars) == len(plan.kinds)
    for m, *numbers in bars:
        s2, goal, collision, other, clearance = map(float, numbers)
        i = int(m)
        assert s2 == pytest.approx(plan.stage2_cost[i], rel=1e-3) and goal == pytest.approx(plan.goal_cost[i], rel=1e-3)
        assert collision == pytest.approx(plan.collision_cost[i], rel=1e-3, abs=1e-3)
        assert other == pytest.approx(s2 - goal - collision, rel=0.05, abs=0.002 * s2)
        assert clearance == pytest.approx(plan.clearance[i].min(), abs=0.006)


def check_curves(page: Dashboard, frame: Frame, truth: dict[str, float]) -> None:
    page.history.add(frame)
    plan, best = plan_of(frame), int(frame.plan.best)
    assert plan.temperature is not None
    weights = np.exp(-(plan.stage1_cost[best] - plan.stage1_cost[best].min()) / plan.temperature[best])
    thrust, *rates = plan.controls[best, 0]
    expected = {
        "speed": truth["speed"],
        "clearance": truth["clearance"],
        "plan_clearance": plan.clearance[best].min(),
        "z": truth["z"],
        "goal_distance": truth["goal"],
        "plan_ms": plan.stage_ms["total"],
        "safe": np.count_nonzero(frame.is_safe),  # type: ignore[arg-type]
        "samples": weights.sum() ** 2 / (weights**2).sum(),
        "cost": plan.stage2_cost[best],
        "goal_cost": plan.goal_cost[best],
        "collision_cost": plan.collision_cost[best],
        "F_t": thrust,
        **dict(zip(("omega_x", "omega_y", "omega_z"), rates, strict=True)),
    }
    past = page.history.past()
    at = int(np.flatnonzero(past.rows[:, 0] == frame.time)[0])
    for name, value in expected.items():
        assert past.column(name)[at] == pytest.approx(float(value), rel=1e-5, abs=1e-6), name


def check_report(trace: FlightTrace, evidence: Evidence, truth: dict[str, float]) -> None:
    """Check the report on a flight that ends at its last tick."""
    report, _ = explain_flight(trace)
    frame, plan = trace.last, trace.last.plan
    text = report.format_table()
    ended, x, y, z = map(
        float, re.findall(r"ended ([\d.]+) m from the goal, at \(([-\d.]+), ([-\d.]+), ([-\d.]+)\)", text)[0]
    )
    assert ended == pytest.approx(truth["goal"], abs=0.06) and z == pytest.approx(truth["z"], abs=0.006)
    assert np.linalg.norm(np.asarray(frame.observation.goal.position) - (x, y, z)) == pytest.approx(ended, abs=0.1)
    blocked = evidence.stage2.values_of("blocked_path").sum(axis=1)
    for m, row in enumerate(report.blocked):
        reach = frame.config.costs.distance_max
        assert min(row["clearance_m"], reach) == pytest.approx(min(plan.clearance[m].min(), reach), abs=0.003)
        assert row["safe"] == evidence.is_safe[m] and row["kind"] == plan.kinds[m]
        assert row["blocked_path"] == pytest.approx(blocked[m], abs=0.06)
    assert ("computed again" in text) == (frame.recorded_plan is not None)
    anchors = evidence.is_safe[: frame.config.anchor_count]
    assert f"{np.count_nonzero(~anchors)} of {len(anchors)} anchors are unsafe" in text
