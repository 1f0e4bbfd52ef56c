"""Report on a flight that did not arrive: the obstacle, when it was first seen, and when braking would have worked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlanStatus
from aero_planner.plan import BrakingCandidates
from aero_planner.quaternions import rotate
from aero_planner.stages.stop_proof.stops import STOPPED
from aero_viz.explain.contact import contact, meeting_sentence
from aero_viz.explain.decision import Decision
from aero_viz.explain.evidence import Evidence, PlanEvidence, Replanner
from aero_viz.explain.trace import FlightTrace
from aero_viz.explain.verdict import closest
from aero_viz.explain.visibility import Seen, find_seen
from aero_viz.planners.plan import ensemble
from aero_viz.scenes import World
from aero_viz.session.engine import PLANNER_FAILED
from aero_viz.session.frame import Frame

Array = NDArray[np.float64]
FAILURES = ("collision", "stall", "out_of_bounds", "timeout")
"""Outcomes that are explained."""
_APPROACH_MIN = 0.5
"""Mean speed from which a drone is on its way to the goal [m/s]."""
_ENDS = {"stall": "stalled", "timeout": "out of time", "out_of_bounds": "left the world"}
_MOVING = "hit a moving obstacle"
_AGAIN = "computed again"
_STEP = 0.01
"""Step for the velocity of an obstacle [s]."""
_RADIUS = 6
"""Column of `World.cylinders` with the radius."""
_SAME_OBSTACLE = 0.5
"""Largest distance from the surface of an obstacle at which a tracked obstacle is the same one [m]."""


@dataclass(frozen=True)
class BrakingTick:
    """The last tick from which braking would have worked, from the true state of the drone."""

    time_s: float
    before_end_s: float
    speed: float
    """[m/s]"""
    tilt_deg: float
    safe: list[int]
    """Instances that the planner counted as safe."""
    is_computed_again: bool
    """True if `safe` was computed again, since a log does not hold it."""
    instances: int
    flown: int
    """Instance that was flown, recorded in a log."""
    kind: str
    """Kind of that instance."""
    clearance_m: float
    """Clearance of its plan, recorded in a log, at most costs.distance_max."""
    status: str
    """Status of the plan, recorded in a log."""
    estimate_off_m: float
    """Distance of the estimated position from the true one."""
    estimated_until_s: float | None
    """Last tick from which braking would have worked from the estimated state; None if there is none."""


@dataclass(frozen=True)
class PostMortem:
    """Report on a flight."""

    scene: str
    outcome: str | None
    time_s: float
    cause: str | None
    """A few words, by which failures are counted; None for a flight that arrived."""
    obstacle: str | None = None
    seen: Seen | None = None
    braking: BrakingTick | None = None
    blocked: list[dict[str, Any]] = field(default_factory=list)
    """For a stall, one entry per instance on the obstacle that blocks it: number, kind, obstacle, clearance [m] and
    cost-to-go. Computed again where the flight is that of a log."""
    sentences: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    """Questions that could not be answered."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return asdict(self)

    def format_table(self) -> str:
        """Return the report as text."""
        ending = (self.outcome or "not over").replace("_", " ")
        lines = [f"{self.scene}: {ending} after {self.time_s:.2f} s"]
        lines += [f"cause: {self.cause}"] if self.cause else []
        return "\n".join([*lines, *(f"- {text}" for text in self.sentences), *(f"? {text}" for text in self.missing)])


def explain_flight(trace: FlightTrace) -> tuple[PostMortem, PlanEvidence | None]:
    """Return the report on a flight that has ended, and the evidence of the tick that matters most.

    That tick is the last one from which braking would have worked, or the last one of the flight.
    """
    if not trace.frames:
        return PostMortem("", trace.outcome, 0.0, None, missing=["The flight has no ticks."]), None
    last = trace.last
    outcome = trace.outcome or last.outcome
    facts: dict[str, Any] = {"scene": last.source.name, "outcome": outcome, "time_s": round(trace.end_time, 3)}
    if outcome not in FAILURES:
        text = (
            "The flight arrived: there is nothing to explain." if outcome == "arrived" else "The flight was not over."
        )
        if outcome == PLANNER_FAILED:
            why = trace.explanation or last.explanation or "It did not say why."
            return PostMortem(**facts, cause="the planner failed", sentences=[why], missing=trace.missing), None
        return PostMortem(**facts, cause=None, sentences=[text], missing=trace.missing), None
    replan = Replanner()
    try:
        if outcome == "collision":
            return _collision(trace, facts, replan)
        return _no_progress(trace, facts, replan)
    finally:
        replan.close()


def _collision(trace: FlightTrace, facts: dict[str, Any], replan: Replanner) -> tuple[PostMortem, PlanEvidence | None]:
    last, end = trace.last, trace.end_position
    world = last.world
    frames = [frame for frame in trace.frames if frame.time < trace.end_time - 1e-9] or list(trace.frames)
    place, obstacle, normal = contact(last, world, end)
    sentences = [f"It hit {obstacle} at {_point(end)}." if world else f"It collided at {_point(end)}."]
    velocity = trace.end_velocity
    moving_row = _moving_row(last.moving_world, obstacle)
    if world is not None and last.moving_world is not None and moving_row is not None:
        speed = float(np.linalg.norm(last.moving_world.motion[moving_row, :2]))
        now, before = (last.moving_world.at(trace.end_time - late).cylinders[moving_row] for late in (0.0, _STEP))
        velocity = velocity - (now - before)[:3] / _STEP
        cylinders = np.stack([last.moving_world.at(frame.time).cylinders[moving_row] for frame in frames])
        place = place + cylinders[:, :3] - world.cylinders[moving_row, :3]
        sentences = [f"It hit {obstacle}, which moves at {speed:.1f} m/s, at {_point(end)}."]
        sentences += _followed_sentence(frames, cylinders)
    sentences += meeting_sentence(normal, velocity)
    seen = find_seen(frames, place)
    estimated = _last_braking(frames, last.moving_world, trace.rules.radius, _planned_braking)
    frame = estimated
    if any(map(_has_estimate, frames)):
        frame = _last_braking(
            frames, last.moving_world, trace.rules.radius, lambda f: replan.braking(f, f.observation.actual_state)
        )
    until = None if estimated is None else round(estimated.time, 3)
    evidence = None if frame is None else replan(frame)
    braking = None if frame is None or evidence is None else _braking_tick(frame, evidence, trace.end_time, until)
    sentences += [_seen_sentence(seen, braking), *_sight_sentence(seen)]
    if ensemble(last.plan) is None:
        sentences.append("Whether braking would have worked is not known: this planner reports no braking paths.")
    else:
        sentences += _braking_sentences(frames, braking, until)
    status = Decision.of(frames[-1]).status
    if was_braking := status != PlanStatus.OK:
        since = next((f.time for f in reversed(frames) if Decision.of(f).status != status), frames[0].time)
        sentences.append(f"It was stopping when it hit: {_stop_reason(frames[-1], status)} after {since:.2f} s.")
    cause = _cause(seen, braking, was_braking, is_start=trace.end_time == 0.0)
    if moving_row is not None:
        cause = f"{_MOVING}: {cause}"
    report = PostMortem(
        **facts, cause=cause, obstacle=obstacle, seen=seen, braking=braking, sentences=sentences, missing=trace.missing
    )
    return report, evidence or replan(frames[-1])


def _moving_row(world: World | None, obstacle: str) -> int | None:
    """Return the row of the cylinder with a name of `World.nearest` if it moves."""
    kind, _, row = obstacle.partition(" ")
    if world is None or not len(world.motion) or kind != "cylinder":
        return None
    return int(row) if np.any(world.motion[int(row), :2]) else None


def _followed_sentence(frames: list[Frame], cylinders: Array) -> list[str]:
    """Say since when the planner has followed an obstacle, without a gap up to the end; nothing if it is unknown.

    `cylinders` are its rows of `World.cylinders` at the times of the frames, shape [frames, 8].
    """
    since: float | None = None
    again = _again(Decision.of(frames[-1]).is_recorded)
    for frame, cylinder in zip(reversed(frames), reversed(cylinders), strict=True):
        plan = ensemble(frame.plan)
        moving = None if plan is None else plan.moving
        if moving is None:
            return []
        distances = np.linalg.norm(moving.positions - cylinder[:2], axis=1)
        if not (distances < cylinder[_RADIUS] + _SAME_OBSTACLE).any():
            break
        since = frame.time
    if since is None:
        return [f"The planner did not track it as moving at the end{again}."]
    earlier = " or earlier" if since == frames[0].time else ""
    return [f"The planner had tracked its motion since {since:.2f} s{earlier}{again}."]


def _cause(seen: Seen, braking: BrakingTick | None, was_braking: bool, *, is_start: bool) -> str:
    if is_start:
        return "start inside an obstacle"
    is_late = seen.since_s is None or (braking is not None and not seen.from_start and seen.since_s > braking.time_s)
    if is_late:
        return f"{'not seen' if seen.since_s is None else 'seen too late'}: {seen.reason}"
    return "seen, stopped too late" if was_braking else "seen, flown into with a plan that counted as safe"


def _seen_sentence(seen: Seen, braking: BrakingTick | None) -> str:
    if seen.since_s is None:
        return f"It was not in the cloud: {seen.detail}."
    if seen.from_start:
        return f"It had been in the cloud since {seen.since_s:.2f} s or earlier."
    before = "" if braking is None or seen.since_s <= braking.time_s else ", too late to brake"
    return f"It had been in the cloud since {seen.since_s:.2f} s{before}; before that, it was {seen.detail}."


def _sight_sentence(seen: Seen) -> list[str]:
    """Say that an obstacle in the cloud was out of sight at the end; nothing if it was in sight, or is not known."""
    if seen.since_s is None or not seen.last_sight:
        return []
    until = "not once in the last ticks" if seen.in_sight_s is None else f"last at {seen.in_sight_s:.2f} s"
    return [f"The sensor had it in sight {until}; at the end it was only remembered: {seen.last_sight}."]


def _planned_braking(frame: Frame) -> BrakingCandidates | None:
    """Return the braking candidates of a plan; None if its planner has none."""
    plan = ensemble(frame.plan)
    return None if plan is None else plan.braking


def _has_estimate(frame: Frame) -> bool:
    """Return True if the planner's state differs from the true one."""
    return frame.observation.actual_state is not frame.observation.state


def _last_braking(
    frames: list[Frame], world: World | None, radius: float, braking_of: Callable[[Frame], BrakingCandidates | None]
) -> Frame | None:
    """Return the last frame with a braking manoeuvre, as the planner models it, that keeps clear of every obstacle.

    Obstacles are those of the world; without a world, the points of the last cloud. `braking_of` returns the
    manoeuvres of a frame.
    """
    cloud = frames[-1].observation.points
    for frame in reversed(frames):
        braking = braking_of(frame)
        if braking is None:
            return None
        paths = braking.positions.astype(np.float64)
        places = np.concatenate((paths, 0.5 * (paths[:, 1:] + paths[:, :-1])), axis=1)
        if world is not None:
            steps = frame.config.control_step * np.arange(paths.shape[1])
            times = frame.time + np.concatenate((steps, 0.5 * (steps[1:] + steps[:-1])))
            distance = world.distance(places.reshape(-1, 3), np.tile(times, len(paths)))
        else:
            from scipy.spatial import KDTree

            distance = KDTree(cloud).query(places.reshape(-1, 3))[0]
        clear = np.asarray(distance).reshape(len(paths), -1).min(axis=1) >= radius
        slow = np.linalg.norm(braking.velocities[:, -1], axis=1) < float(STOPPED)
        if (clear & slow).any():
            return frame
    return None


def _braking_tick(frame: Frame, evidence: PlanEvidence, end: float, estimated_until: float | None) -> BrakingTick:
    state, decision = frame.observation.actual_state, Decision.of(frame)
    off = np.subtract(frame.observation.state.position, state.position)
    up = rotate(np.asarray(state.quaternion), np.array([0.0, 0.0, 1.0]))
    return BrakingTick(
        time_s=round(frame.time, 3),
        before_end_s=round(end - frame.time, 3),
        speed=float(np.linalg.norm(np.asarray(state.velocity))),
        tilt_deg=float(np.degrees(np.arccos(np.clip(up[2], -1.0, 1.0)))),
        safe=[] if _is_none_safe(frame, decision) else [int(m) for m in np.flatnonzero(evidence.is_safe)],
        is_computed_again=decision.is_recorded and not _is_none_safe(frame, decision),
        instances=len(evidence.is_safe),
        flown=decision.instance,
        kind=decision.kind,
        clearance_m=round(decision.clearance, 3),
        status=decision.status.name,
        estimate_off_m=round(float(np.linalg.norm(off)), 3),
        estimated_until_s=estimated_until,
    )


def _braking_sentences(frames: list[Frame], braking: BrakingTick | None, estimated_until: float | None) -> list[str]:
    """Say from where braking would have worked, from the true and from the estimated state, and what was flown."""
    is_log, has_estimate = Decision.of(frames[-1]).is_recorded, any(map(_has_estimate, frames))
    start = " from its true state" if has_estimate else ""
    if braking is None:
        sentences = [f"Braking{start} would not have worked from any of the last {len(frames)} ticks{_again(is_log)}."]
        off = ""
    else:
        count = len(braking.safe)
        which = f"{count} of {braking.instances} candidates were safe"
        which += f" (instance{'s' * (count > 1)} {', '.join(map(str, braking.safe))})" if 0 < count <= 8 else ""
        which += _again(braking.is_computed_again)
        sentences = [
            f"The last tick from which braking{start} would have worked is {braking.time_s:.2f} s{_again(is_log)}, "
            f"{braking.before_end_s:.2f} s before the end: speed {braking.speed:.1f} m/s, tilt {braking.tilt_deg:.0f} "
            f"deg; {which}, and instance {braking.flown} ({braking.kind}) was flown, with a clearance of "
            f"{braking.clearance_m:.2f} m."
        ]
        off = f", {braking.estimate_off_m:.2f} m off at that tick"
    if has_estimate:
        until = "at no tick" if estimated_until is None else f"until {estimated_until:.2f} s"
        sentences.append(f"From the state that the planner took for true{off}, it would have worked {until}.")
    return sentences


def _is_none_safe(frame: Frame, decision: Decision) -> bool:
    """Return True if a log says that no candidate was safe."""
    is_unsafe = decision.status == PlanStatus.NO_SAFE_CANDIDATE
    return decision.is_recorded and is_unsafe and frame.config.prefers_safe


def _stop_reason(frame: Frame, status: PlanStatus) -> str:
    """Return why the planner stops the drone."""
    if status == PlanStatus.STALE_CLOUD:
        return "the cloud was stale"
    return "no candidate was safe" if frame.config.prefers_safe else "the cheapest candidate was not safe"


def _stops(frames: list[Frame]) -> dict[str, int]:
    """Return the number of frames in which the planner stops the drone, by the reason."""
    statuses = Counter(Decision.of(frame).status for frame in frames)
    return {_stop_reason(frames[-1], status): statuses[status] for status in PlanStatus if status != PlanStatus.OK}


def _again(is_again: bool) -> str:
    """Return the mark of what a log does not hold."""
    return f" ({_AGAIN})" if is_again else ""


def _no_progress(trace: FlightTrace, facts: dict[str, Any], replan: Replanner) -> tuple[PostMortem, PlanEvidence]:
    """Explain a flight that stalled, ran out of time or left the world, by its last plan."""
    last, frames = trace.last, list(trace.frames)
    evidence = replan(last)
    if not isinstance(evidence, Evidence):
        return _no_progress_of_paths(trace, facts, evidence)
    to_go, escape = (evidence.stage2.values_of(name).sum(axis=1) for name in ("blocked_path", "escape"))
    rows = []
    for m, kind in enumerate(evidence.plan.kinds):
        clearance, time, name = closest(evidence, m)
        row = {"instance": m, "kind": kind, "safe": bool(evidence.is_safe[m]), "obstacle": name}
        row |= {"clearance_m": round(clearance, 3), "at_s": round(time, 3), "blocked_path": round(float(to_go[m]), 1)}
        rows.append(row | {"escape": round(float(escape[m]), 1)})
    config: Any = last.config
    anchors = rows[: config.anchor_count]
    limit = config.costs.distance_max
    blocking = Counter(row["obstacle"] for row in anchors if not row["safe"] or row["clearance_m"] < limit)
    nearest = ", ".join(f"{name} ({n})" for name, n in blocking.most_common(4))
    unsafe, weight = sum(not row["safe"] for row in anchors), config.costs.q_blocked
    again, stops = _again(Decision.of(last).is_recorded), _stops(frames)
    sentences = [
        *_end_sentences(trace),
        f"{unsafe} of {len(anchors)} anchors are unsafe in the last plan{again}."
        + (f" Nearest to the anchors: {nearest}." if nearest else ""),
        *(f"{why.capitalize()} in {count} of the last {len(frames)} ticks." for why, count in stops.items() if count),
    ]
    if weight > 0.0:
        free = int((to_go[: len(anchors)] < 0.1 * weight).sum())
        sentences.append(
            f"The cost-to-go finds the way to the goal free beyond {free} of {len(anchors)} anchors; beyond the others "
            f"up to {to_go.max() / weight:.1f} m of {config.lookahead:g} m are blocked{again}."
        )
    if places := evidence.places:
        are = "place without progress is" if places == 1 else "places without progress are"
        sentences.append(f"{places} {are} remembered nearby{again}.")
    approach = _approach(frames)
    cause = _stall_cause(facts["outcome"], anchors, stops, len(frames), to_go[: len(anchors)], approach)
    return PostMortem(**facts, cause=cause, blocked=rows, sentences=sentences, missing=trace.missing), evidence


def _no_progress_of_paths(
    trace: FlightTrace, facts: dict[str, Any], evidence: PlanEvidence
) -> tuple[PostMortem, PlanEvidence]:
    """Explain a flight without a collision by what every planner tells: its status, and its candidates' costs."""
    frames, plan, best = list(trace.frames), evidence.plan, int(evidence.plan.best)
    stops = _stops(frames)
    terms = ", ".join(f"{name} {cost[best]:.3g}" for name, cost in plan.costs.items())
    sentences = [
        *_end_sentences(trace),
        f"{np.count_nonzero(evidence.is_safe)} of {len(plan.kinds)} candidates are safe in the last plan.",
        f"It chose candidate {best} ({plan.kinds[best]}), at a cost of {float(plan.cost[best]):.3g}: {terms}.",
        *(f"{why.capitalize()} in {count} of the last {len(frames)} ticks." for why, count in stops.items() if count),
    ]
    name, approach = _ENDS[facts["outcome"]], _approach(frames)
    nearer = f"coming nearer to the goal at {approach:.1f} m/s"
    motion = nearer if approach > _APPROACH_MIN else "moving without coming nearer"
    cause = next((why for why, count in stops.items() if count > 0.5 * len(frames)), motion)
    return PostMortem(**facts, cause=f"{name}: {cause}", sentences=sentences, missing=trace.missing), evidence


def _end_sentences(trace: FlightTrace) -> list[str]:
    """Return how far from its goal the flight ended, after the waypoints that it gave up."""
    observation, end = trace.last.observation, trace.end_position
    place, name, given_up = np.asarray(observation.goal.position), "the goal", []
    if (mission := observation.mission) is not None:
        given_up = [event.text for event in mission.events if event.kind == "given_up"]
        place = np.array(mission.waypoint.at(trace.end_time - mission.since))
        name = name if mission.is_last else f"waypoint {mission.index + 1} of {len(mission.mission)}"
    return [*given_up, f"It ended {np.linalg.norm(place - end):.1f} m from {name}, at {_point(end)}."]


def _approach(frames: list[Frame]) -> float:
    """Return the mean speed at which the drone came nearer to its present goal in some frames [m/s]."""
    goal = np.asarray(frames[-1].observation.goal.position)
    first, last = (np.linalg.norm(goal - np.asarray(frames[i].observation.actual_state.position)) for i in (0, -1))
    return float(first - last) / max(frames[-1].time - frames[0].time, 1e-9)


def _stall_cause(
    outcome: str, anchors: list[dict[str, Any]], stops: dict[str, int], ticks: int, to_go: Array, approach: float
) -> str:
    name = _ENDS[outcome]
    if why := next((why for why, count in stops.items() if count > 0.5 * ticks), None):
        return f"{name}: {why}"
    if approach > _APPROACH_MIN:
        return f"{name}: coming nearer to the goal at {approach:.1f} m/s"
    if not any(row["safe"] for row in anchors):
        return f"{name}: every anchor is blocked"
    return f"{name}: {'the way to the goal is blocked' if (to_go > 0.0).all() else 'moving without coming nearer'}"


def _point(place: Array) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in place) + ") m"
