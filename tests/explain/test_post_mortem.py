"""Reports on flights whose cause is known."""

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from ensemble_plans import plan_of

from aero_planner import PlannerConfig, PlanStatus, Sweeps
from aero_planner.missions import Mission, Waypoint
from aero_viz.dashboard import palette
from aero_viz.errors import UserError
from aero_viz.explain.decision import Decision
from aero_viz.explain.picture import COLORS, draw_map
from aero_viz.explain.post_mortem import PostMortem, explain_flight
from aero_viz.explain.trace import FlightTrace, recorder, trace_of_log
from aero_viz.explain.visibility import find_seen
from aero_viz.flight import FlightRules, FlightSource, StateNoise, VehicleModel, fly
from aero_viz.scenes import World, scene
from aero_viz.scenes.obstacles import new_obstacle, with_obstacle
from aero_viz.session import Session
from tests.explain.conftest import OPEN_ABOVE

GROUND = [0.0, 0.0, -0.5, 80.0, 80.0, 1.0, 0.0]


def world_of(goal: list[float], box: list[float]) -> World:
    return World.from_dict({"name": "test", "start": [0, 0, 2], "goal": goal, "boxes": [GROUND, box]})


def flown(world: World, *, config: PlannerConfig = OPEN_ABOVE, **options: Any) -> Any:
    trace = FlightTrace()
    result = fly(world, config=config, recorder=recorder(trace), **options)
    return result, trace, *explain_flight(trace)


@pytest.fixture(scope="module")
def trap(tmp_path_factory):
    log = tmp_path_factory.mktemp("trap") / "trap.mcap"
    trace = FlightTrace()
    fly(scene("double_wall_trap", seed=14), config=OPEN_ABOVE, recorder=recorder(trace, log))
    return trace, log


def test_the_trap_hits_the_ceiling_that_the_sensor_does_not_see(trap):
    explained: Any = explain_flight(trap[0])
    report, evidence = explained
    assert report.outcome == "collision" and report.obstacle == "box 7"
    assert report.cause == "seen too late: outside the field of view"
    assert "which sees -7 to 52 deg" in report.seen.detail
    assert 0.0 < report.braking.time_s < report.seen.since_s < report.time_s
    assert report.braking.safe and evidence is not None and evidence.frame.time == pytest.approx(report.braking.time_s)
    assert "box 7" in report.format_table() and report.to_dict()["seen"]["since_s"] == report.seen.since_s
    radius = trap[0].rules.radius
    for frame in trap[0].frames:
        clear = [evidence.frame.source.world.distance(path).min() >= radius for path in frame.plan.braking.positions]
        assert frame.time <= report.braking.time_s or not any(clear), "no later tick could have braked"


def test_a_log_tells_the_same_and_says_what_it_lacks(trap):
    report, _ = explain_flight(trace_of_log(trap[1]))
    assert report.obstacle == "box 7" and report.cause == "seen too late: outside the field of view"
    assert report.time_s == pytest.approx(explain_flight(trap[0])[0].time_s, abs=0.02)
    assert any("computed again" in text for text in report.missing)


def test_a_file_that_is_no_log_is_refused(tmp_path):
    with pytest.raises(UserError, match="no file"):
        trace_of_log(tmp_path / "none.mcap")
    (tmp_path / "other.mcap").write_bytes(b"nothing")
    with pytest.raises(UserError, match="not a flight log"):
        trace_of_log(tmp_path / "other.mcap")


def test_the_picture_shows_the_candidates_and_the_end(trap):
    _, evidence = explain_flight(trap[0])
    assert evidence is not None
    picture = draw_map(evidence, trap[0].end_position)
    chosen = [path for path in re.findall("<polyline[^>]*>", picture) if COLORS["chosen"] in path]
    assert len(chosen) == 1 and COLORS["braking"] in picture
    assert ">- - braking</tspan>" in picture, "the key has dashes, as the lines"
    assert picture.count("<polyline") == 16 + 5 and "<rect x=" in picture and "l18 18" in picture


def test_the_picture_has_the_colours_of_the_page_and_a_text_that_a_panel_shows_large_enough(trap):
    of_page = {
        "safe": palette.GOOD,
        "unsafe": palette.BAD,
        "chosen": palette.CHOSEN,
        "braking": palette.DRONE,
        "obstacle": palette.OBSTACLE,
        "point": palette.MUTED,
        "text": palette.DRONE,
        "ground": palette.PANEL[7],
    }
    assert {name: "#" + bytes(color).hex() for name, color in of_page.items()} == COLORS
    _, evidence = explain_flight(trap[0])
    assert evidence is not None
    picture = draw_map(evidence)
    width = float(re.findall(r'viewBox="0 0 (\d+)', picture)[0])
    size = float(re.findall(r'font-size="(\d+)"', picture)[0])
    assert 285.0 * size / width >= 11.0, "in a panel of 285 pixels"


def test_the_report_tells_the_number_of_an_instance_from_a_count(trap):
    report, evidence = explain_flight(trap[0])
    assert evidence is not None and report.braking is not None
    best = int(evidence.plan.best)
    assert (
        f", and instance {best} ({evidence.plan.kinds[best]}) was flown, with a clearance of " in report.format_table()
    )
    assert re.search(
        r"\d+ of 16 candidates were safe( \(instances? \d+(, \d+)*\))?, and instance", report.format_table()
    )


def test_the_obstacle_of_a_collision_among_cylinders_is_named():
    result, trace, report, _ = flown(scene("verticals", count=1000, seed=0), config=PlannerConfig.preset("paper"))
    assert result.reason == report.outcome == "collision"
    assert report.obstacle in re.findall(r"cylinder \d+", result.explanation)
    assert report.seen is not None and report.cause.startswith("seen")
    assert len(trace.frames) <= 301


def test_a_fast_obstacle_is_named_with_its_speed():
    pillar, motion = [[6.0, 0, 0, 0, 0, 1, 0.5, 8]], [[-9.0, 0.0, 40.0]]
    content = {"name": "test", "start": [0, 0, 2], "goal": [0, 0.5, 2], "cylinders": pillar, "motion": motion}
    world = World.from_dict({**content, "boxes": [GROUND, [0, 2, 2, 4, 1, 4, 0], [0, -2, 2, 4, 1, 4, 0]]})
    rules = FlightRules(arrival_radius=0.01)
    _, _, report, evidence = flown(world, rules=rules)
    assert report.outcome == "collision" and report.cause.startswith("hit a moving obstacle: ")
    assert report.obstacle == "cylinder 0" and "moves at 9.0 m/s" in report.format_table()
    assert "did not track it as moving" in report.format_table(), "it is faster than any that the planner follows"
    assert report.seen is not None and report.braking is None
    assert evidence is not None


def test_an_obstacle_that_comes_out_from_behind_another_was_occluded():
    """It moves across the way of the drone, behind a wall that ends beside the way."""
    config = OPEN_ABOVE.replace(
        {"vehicle.speed_limit": 4.0, "moving_obstacles.predict": False, "stop_proof.prove_stop": False,
         "candidates.prefer_safe": False}
    )  # fmt: skip
    content = {"name": "test", "start": [-5, 0, 2], "goal": [25, 0, 2]}
    content["boxes"] = [GROUND, [8.0, -20.8, 4, 0.2, 40, 8, 0]]
    _, alone, *_ = flown(World.from_dict(content), config=config)
    # The pillar comes where the drone would be without it. It was hidden during the sweeps before the start, too.
    crossing = next(frame for frame in alone.frames if frame.observation.actual_state.position[0] > 9.0)
    start = crossing.observation.actual_state.position[1] - 3.4 * crossing.time
    pillar, motion = [[9.0, start, 0, 0, 0, 1, 0.5, 8]], [[0.0, 3.4, 40.0]]
    _, trace, report, _ = flown(World.from_dict({**content, "cylinders": pillar, "motion": motion}), config=config)
    assert report.outcome == "collision" and report.obstacle == "cylinder 0"
    assert report.seen is not None and report.seen.since_s is not None and report.seen.reason == "occluded"
    assert "occluded by box 1" in report.seen.detail
    # The place of the contact comes out from behind the wall when the line of sight from the drone passes its end.
    to_drone = np.asarray(trace.end_position)[:2] - trace.frames[-1].world.cylinders[0, :2]
    frame = next(frame for frame in trace.frames if frame.time >= report.seen.since_s - 1e-9)
    eye = np.asarray(frame.observation.actual_state.position)
    place = frame.world.cylinders[0, :2] + 0.5 * to_drone / np.linalg.norm(to_drone)
    at_wall = eye[1] + (place[1] - eye[1]) * (8.0 - eye[0]) / (place[0] - eye[0])
    assert at_wall == pytest.approx(-0.8, abs=0.3)


def test_a_box_overhead_is_never_seen():
    """Straight up lies outside the field of view of a Mid-360."""
    world = world_of([0, 0.5, 14], [0, 0, 7, 12, 12, 0.4, 0])
    result, _, report, _ = flown(world)
    assert result.reason == "collision" and report.obstacle == "box 1"
    assert report.cause.endswith(": outside the field of view")


@pytest.fixture(scope="module")
def standing():
    """A drone before a wall that it does not get past."""
    world = world_of([14, 0, 2], [6, 0, 5, 0.3, 78, 10, 0])
    return flown(world, rules=FlightRules(stall_time=1.5, stall_distance=4.0))


def test_a_stall_tells_what_blocks_the_anchors(standing):
    result, _, report, evidence = standing
    assert result.reason == report.outcome == "stall" and report.cause.startswith("stalled: ")
    assert {row["obstacle"] for row in report.blocked} & {"box 1"}
    assert any("cost-to-go" in text for text in report.sentences) and evidence is not None


def test_the_report_names_the_waypoints_that_were_given_up():
    world = world_of([14, 0, 2], [6, 0, 5, 0.3, 78, 10, 0])
    route = Mission((Waypoint((6, 0, 2), radius=0.2, timeout=1.5), Waypoint((14, 0, 2))))
    rules = FlightRules(stall_time=1.5, stall_distance=4.0)
    result, _, report, _ = flown(world.with_mission(route), rules=rules)
    assert result.reason == "stall" and (result.waypoints, result.waypoints_passed) == (2, 0)
    given_up, end = report.sentences[:2]
    assert given_up.startswith("Waypoint 1 of 2 at (6, 0, 2) was given up") and "it lies inside box 1" in given_up
    assert re.match(r"It ended \d+\.\d m from the goal, at \(", end)


def report_with_stale_clouds(trace: FlightTrace) -> PostMortem:
    stale = FlightTrace()
    stale.end = trace.end
    for frame in trace.frames:
        stale.write(dataclasses.replace(frame, plan=dataclasses.replace(plan_of(frame), status=PlanStatus.STALE_CLOUD)))
    return explain_flight(stale)[0]


def test_a_stale_cloud_is_named_as_the_reason_of_a_stop(trap):
    sentences = report_with_stale_clouds(trap[0]).sentences
    assert any("It was stopping when it hit: the cloud was stale after" in text for text in sentences)


def test_a_stale_cloud_is_named_as_the_cause_of_a_stall(standing):
    report, ticks = report_with_stale_clouds(standing[1]), len(standing[1].frames)
    assert report.cause == "stalled: the cloud was stale"
    assert f"The cloud was stale in {ticks} of the last {ticks} ticks." in report.sentences


@pytest.mark.parametrize(
    ("place", "reason", "words"),
    [
        ([9.0, 0.0, 2.0], "occluded", "occluded by box 1"),
        ([-30.0, 0.0, 2.0], "beyond range", "beyond the range of 10 m"),
        ([2.0, 0.0, 11.0], "outside the field of view", "which sees -7 to 52 deg"),
    ],
)
def test_a_place_that_was_not_seen_has_a_reason(standing, place, reason, words):
    seen = find_seen(list(standing[1].frames)[:40], np.array(place))
    assert seen.since_s is None and seen.reason == reason and words in seen.detail


def test_a_surface_that_left_the_cloud_is_forgotten(standing):
    frames = list(standing[1].frames)[:20]
    position = frames[0].observation.points
    place = position[np.linalg.norm(position - [5.85, 0.0, 2.0], axis=1).argmin()].astype(np.float64)
    assert find_seen(frames, place).from_start
    empty = [
        dataclasses.replace(frame, observation=dataclasses.replace(frame.observation, sweeps=Sweeps()))
        for frame in frames[10:]
    ]
    seen = find_seen([*frames[:10], *empty], place)
    assert seen.reason == "forgotten" and seen.forgotten_s == frames[9].time


def test_an_obstacle_that_was_added_during_the_flight_is_named():
    source = FlightSource(world_of([20, 0, 2], [10, 9, 2, 1, 1, 1, 0]))
    session, trace = Session(source), FlightTrace()
    for _ in range(40):
        trace.write(session.tick())
    wall = new_obstacle("box", np.add(source.observe().actual_state.position, (1.0, 0.0, 0.0)), [0.5, 4.0, 4.0])
    session.alter(lambda flight: flight.set_world(with_obstacle(flight.observe().world, wall))).result()
    while session.frame is not None and session.frame.outcome is None:
        trace.write(session.tick())
    session.close()
    report, _ = explain_flight(trace)
    assert report.outcome == "collision" and report.obstacle == "box 2"
    assert trace.last.world is not trace.last.source.world


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "solid",
    [{"cylinders": [[0, 0, 0, 0, 0, 1, 0.5, 5]]}, {"spheres": [[0, 0, 2, 1]]}, {"boxes": [[0, 0, 2, 1, 1, 1, 0]]}],
    ids=["cylinder", "sphere", "box"],
)
def test_a_start_in_the_centre_of_an_obstacle_is_explained(solid: dict[str, Any]):
    world = World.from_dict({"name": "buried", "start": [0, 0, 2], "goal": [20, 0, 2], **solid})
    _, _, report, _ = flown(world)
    assert report.outcome == "collision" and report.obstacle in str(report.format_table())


def test_a_flight_that_was_on_its_way_is_not_blamed_for_standing_still():
    world = world_of([30.0, 0.0, 2.0], [10.0, 9.0, 1.0, 1.0, 1.0, 2.0, 0.0])
    _, _, report, _ = flown(world, rules=FlightRules(time_limit=3.0))
    assert report.outcome == "timeout" and re.match(
        r"out of time: coming nearer to the goal at \d\.\d m/s", report.cause
    )


@pytest.fixture(scope="module")
def gusty(tmp_path_factory):
    """A flight that fails with an estimate that is off, and its log."""
    config = PlannerConfig().replace({"vehicle.speed_limit": 15.0})
    vehicle = VehicleModel.from_config(config, drag=0.3, gust_speed=5.0, latency=0.1)
    noise, folder = StateNoise(position=0.15), tmp_path_factory.mktemp("gusty")
    for seed in range(8):
        log, trace = folder / f"gusty-{seed}.mcap", FlightTrace()
        world = scene("verticals", count=1000, seed=seed)
        result = fly(world, config=config, vehicle=vehicle, noise=noise, recorder=recorder(trace, log))
        if result.reason == "collision":
            return trace, log
    pytest.fail("all flights arrive")


def test_the_report_on_a_log_has_the_decisions_of_the_log_and_marks_what_is_computed_again(gusty):
    flown, _ = explain_flight(gusty[0])
    trace = trace_of_log(gusty[1])
    frames = {round(frame.time, 3): frame for frame in gusty[0].frames}
    assert any(frame.plan.best != frames[round(frame.time, 3)].plan.best for frame in trace.frames), "another plan"
    for frame in trace.frames:
        decision, plan = Decision.of(frame), frames[round(frame.time, 3)].plan
        assert (decision.instance, decision.status, decision.kind) == (plan.best, plan.status, plan.kinds[plan.best])
        assert decision.clearance == pytest.approx(plan.clearance[plan.best].min(), abs=1e-6)
    report, _ = explain_flight(trace)
    assert report.braking is not None
    plan = frames[report.braking.time_s].plan
    assert f"instance {plan.best} ({plan.kinds[plan.best]}) was flown" in report.format_table()
    assert f"with a clearance of {plan.clearance[plan.best].min():.2f} m" in report.format_table()
    assert f"{report.braking.time_s:.2f} s (computed again)" in report.format_table()
    assert report.cause == flown.cause


def test_braking_starts_from_the_true_state_and_the_report_says_what_the_estimate_made_of_it(gusty, replan):
    trace = FlightTrace()
    trace.end = gusty[0].end
    trace.frames.extend(list(gusty[0].frames)[-40:])
    report, _ = explain_flight(trace)
    assert report.braking is not None
    at = next(frame for frame in trace.frames if round(frame.time, 3) == report.braking.time_s).observation
    assert at.true_state is not None
    off = np.linalg.norm(np.subtract(at.state.position, at.true_state.position))
    assert report.braking.estimate_off_m == pytest.approx(off, abs=1e-3) and off > 0.05
    assert report.braking.speed == pytest.approx(np.linalg.norm(at.true_state.velocity))
    ticks = []
    for is_true in (True, False):
        exact = FlightTrace()
        exact.end = trace.end
        for frame in trace.frames:
            seen = frame.observation
            state = seen.true_state if is_true else seen.state
            alone = dataclasses.replace(frame, observation=dataclasses.replace(seen, state=state, true_state=None))
            exact.write(dataclasses.replace(alone, plan=replan(alone).plan) if is_true else alone)
        braking = explain_flight(exact)[0].braking
        ticks.append(None if braking is None else braking.time_s)
    assert [report.braking.time_s, report.braking.estimated_until_s] == ticks
    text = report.format_table()
    assert "from which braking from its true state would have worked is" in text
    assert f"{report.braking.estimate_off_m:.2f} m off at that tick, it would have worked" in text
