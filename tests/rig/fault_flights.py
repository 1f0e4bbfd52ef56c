"""Flights with two or three faults each, drawn by a seed: `python -m tests.rig.fault_flights --seed 0 --count 1000`.

`draw` makes a flight of a seed, `fly` flies it in simulated time, and `broken_promises` judges it.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aero_planner import PlannerConfig
from aero_planner.onboard.settings import OnboardConfig
from aero_viz.flight import FlightRules
from aero_viz.rig import Fault, RigResult, fly_rig
from aero_viz.rig.faults import FAULT_KINDS, NETWORK_FAULTS
from aero_viz.scenes import World
from aero_viz.sensors import LidarModel

CONFIG = PlannerConfig.preset("fast-cpu")
ONBOARD = OnboardConfig().replace({"limits.hold_time": 3.0})
"""A drone that can't fly on is handed back after 8 s, so that the flights are short."""
LIDAR = LidarModel("quarter", pattern="livox", points_per_sweep=5000)
"""A Mid-360 of a quarter of the points: it is the points that take most of the time."""

GUIDE = (Path(__file__).parents[2] / "docs" / "onboard_safety.md").read_text(encoding="utf-8")
LOSS_TIME = 0.2
"""PX4's COM_OF_LOSS_T that preflight sets [s]."""
KINDS = (
    *NETWORK_FAULTS, "freeze-state", "lose-position", "err-velocity", "kill-sensor", "pause-node", "take-over",
    "lose-transmitter", "low-battery", "kill-node", "restart-node",
)  # fmt: skip
_ENDS = ("kill-node", "restart-node")  # at most one of these per flight
_LENGTH, _WIDTH, _POSTS = 24.0, 5.0, 16  # [m] of the way, [m] to each side, and number of posts
_MAX_LOSS = 0.5  # [m] of height
_REACTION = 0.4  # [s] until a fault is noticed, limits.state_age, and until the drone has turned
_ROOM = 1.5  # [m] around start and goal without posts


@dataclass(frozen=True)
class FaultFlight:
    """One flight to fly."""

    seed: int
    world: World
    speed: float
    """Limit [m/s]."""
    faults: tuple[Fault, ...]

    def __str__(self) -> str:
        faults = "; ".join(f"{fault} at {fault.at:g} s" for fault in self.faults)
        return f"{self.seed}: {self.speed:.1f} m/s; {faults}"


def draw(seed: int) -> FaultFlight:
    """Return the flight of a seed: a world of posts, a speed, and two or three faults at times that overlap."""
    random = np.random.default_rng([seed, 0x6661756C])
    count = int(random.integers(2, 4))
    kinds = [str(kind) for kind in random.choice(KINDS, size=count, replace=False)]
    while sum(kind in _ENDS for kind in kinds) > 1:
        kinds = [str(kind) for kind in random.choice(KINDS, size=count, replace=False)]
    first = float(random.uniform(0.5, 4.0))
    times = [first, *(max(0.2, first + random.uniform(-1.0, 2.5)) for _ in kinds[1:])]
    faults = tuple(_fault(kind, at, random) for kind, at in zip(kinds, times, strict=True))
    return FaultFlight(seed, _posts(random), float(random.uniform(2.0, 7.0)), faults)


def _fault(kind: str, at: float, random: np.random.Generator) -> Fault:
    # One in four lasts until the end of the flight.
    duration = (
        100.0 if random.uniform() < 0.25 else round(float(np.exp(random.uniform(math.log(0.1), math.log(5.0)))), 2)
    )
    if not FAULT_KINDS[kind].duration:
        return Fault(kind, round(at, 2))
    if kind in ("pause-node", "take-over"):
        duration = min(duration, 5.0)
    # Of the delays, only what the document promises: it says what a later link costs.
    low, high = {"delay": (0.01, 0.03), "err-velocity": (0.3, 1.5)}.get(kind, (0.1, 0.95))
    amount = round(float(random.uniform(low, high)), 2) if FAULT_KINDS[kind].amount else None
    return Fault(kind, round(at, 2), duration, amount)


def _posts(random: np.random.Generator) -> World:
    start, goal = np.array([0.0, 0.0, 2.0]), np.array([_LENGTH, 0.0, 2.0])
    rows: list[list[float]] = []
    while len(rows) < _POSTS:
        x, y, radius = random.uniform(0.0, _LENGTH), random.uniform(-_WIDTH, _WIDTH), random.uniform(0.1, 0.4)
        ends = min(math.hypot(x - end[0], y - end[1]) for end in (start, goal))
        # The drone fits between any two.
        gaps = [math.hypot(x - row[0], y - row[1]) - radius - row[6] for row in rows]
        if ends - radius > _ROOM and min(gaps, default=math.inf) > 4.0 * FlightRules().radius:
            rows.append([x, y, 0.0, 0.0, 0.0, 1.0, radius, 8.0])
    ground = [_LENGTH / 2, 0.0, -0.5, 120.0, 80.0, 1.0, 0.0]
    return World("posts", start, goal, np.array(rows), np.array([ground]))


def fly(flight: FaultFlight) -> RigResult:
    """Fly in simulated time."""
    return fly_rig(
        flight.world, seed=flight.seed, speed=flight.speed, faults=flight.faults, duration=30.0, config=CONFIG,
        onboard=ONBOARD, lidar=LIDAR, loss_time=LOSS_TIME, lockstep=True,
    )  # fmt: skip


def ending(result: RigResult) -> str:
    """Return how the flight ended, in the words of docs/onboard_safety.md; empty if it has none for it."""
    changes, kinds = _changes(result), {text.split()[0] for _, text in _begins(result)}
    last = changes[-1][1] if changes else ""
    if result.reason == "collision":
        return "collision"
    if " -> ARRIVED" in last and result.trajectory.offboard[-1]:
        return "arrived"  # a drone whose position drifts waits where it believes the goal to be
    if re.search(r" -> (READY|WITHDRAWING|WAITING): (?!the vehicle was disarmed)", last):
        return "pilot"
    if result.reason == "held" and last in _documented_transitions():
        return last
    if result.reason == "held" and kinds & {*_ENDS, "pause-node"}:
        return "failsafe process"
    return "broken link" if result.reason == "held" and kinds & {*NETWORK_FAULTS} else ""


def documented_endings() -> set[str]:
    """Return the endings that docs/onboard_safety.md names: the first words of a list, and transitions of the table."""
    names = re.search(r"A flight ends in one of these ways: (.*?)\n\n", GUIDE, re.DOTALL)
    assert names is not None
    return {*re.findall(r"\*\*(.+?)\*\*", names[1]), *_documented_transitions()}


def _documented_transitions() -> set[str]:
    """Return the transitions of the failsafe table with which the drone is given away."""
    transitions = set()
    for line in GUIDE.splitlines():
        if re.match(r"\| .* s \| ", line):
            cause, sources, target = (cell.strip() for cell in line.split("|")[1:4])
            if target in ("HANDED_BACK", "WAITING"):
                transitions |= {f"{source} -> {target}: {cause}" for source in sources.split(", ")}
    return transitions


def _changes(result: RigResult) -> list[tuple[float, str]]:
    """Return times since the engagement [s] and texts of the node's transitions."""
    return [(e.time or 0.0, e.text.removeprefix("node: ")) for e in result.events if e.text.startswith("node: ")]


def _begins(result: RigResult) -> list[tuple[float, str]]:
    """Return times since the engagement [s] and texts of the faults that began."""
    return [(e.time or 0.0, e.text.removeprefix("fault: ")) for e in result.events if e.text.startswith("fault: ")]


def braked_phases(result: RigResult) -> list[tuple[float, float]]:
    """Return begin and end [s] of the times in which the node, or who acts in its place, did not follow a plan."""
    marks = [(time, re.match(r"\w+ -> (\w+)", text)[1] in ("FLYING", "ARRIVED")) for time, text in _changes(result)]  # type: ignore[index]
    marks += [(time, False) for time, text in _begins(result) if text.startswith((*_ENDS, "pause-node", "take-over"))]
    phases, begin = [], None
    for moment, flies in sorted(marks):
        if flies and begin is not None:
            phases.append((begin, moment))
        begin = None if flies else moment if begin is None else begin
    return phases if begin is None else [*phases, (begin, math.inf)]


def height_loss(result: RigResult) -> float:
    """Return the largest loss of height while the node's side brakes or holds, less what its sinking costs anyway [m].

    What the autopilot's Hold loses after a pilot or a broken link has given it a banked drone is its own.
    """
    path, worst = result.trajectory, 0.0
    excess = CONFIG.vehicle.thrust_max / CONFIG.vehicle.mass - CONFIG.vehicle.gravity
    for begin, end in braked_phases(result):
        inside = (path.times >= begin) & (path.times <= end) & path.offboard
        if inside.any():
            heights, sink = path.positions[inside, 2], max(0.0, -float(path.velocities[inside, 2][0]))
            worst = max(worst, float(heights[0] - heights.min()) - sink**2 / (2.0 * excess))
    return worst


def broken_promises(flight: FaultFlight, result: RigResult) -> list[str]:
    """Return what docs/onboard_safety.md promises and this flight did not keep."""
    broken = []
    if result.reason == "collision" and not (_autopilot_flew(result) or _was_too_close(flight, result)):
        broken.append("collision")
    if (loss := height_loss(result)) > _MAX_LOSS:
        broken.append(f"loses {loss:.2f} m of height")
    if result.reason != "collision" and ending(result) not in documented_endings():
        broken.append(f"ends by {result.reason}, {_changes(result)[-1:]}, which is not documented")
    if result.violations:
        broken.append(f"requests {', '.join(set(result.violations))}")
    if failed := [line for line in result.log if line.endswith(" failed")]:
        broken.append(failed[0])
    return broken


def _autopilot_flew(result: RigResult) -> bool:
    """Return True if the autopilot's Hold, which sees nothing, flew: after a take-over, or without a link."""
    kinds = {text.split()[0] for _, text in _begins(result)}
    return not result.trajectory.offboard[-1] and bool(kinds & {"take-over", *NETWORK_FAULTS})


def _was_too_close(flight: FaultFlight, result: RigResult) -> bool:
    """Return True if a fault began where no drone would have come to rest before an obstacle straight ahead.

    A wrong velocity displaces the drone meanwhile, for the second within which it is to be noticed.
    """
    path = result.trajectory
    aside = sum(fault.amount or 0.0 for fault in flight.faults if fault.kind == "err-velocity") * 1.0
    for begin, _ in _begins(result):
        k = int(np.searchsorted(path.times, begin))
        speed = float(np.linalg.norm(path.velocities[k]))
        way = speed * _REACTION + speed**2 / (2.0 * ONBOARD.brake.acceleration)
        steps = np.linspace(0.0, way, 1 + math.ceil(way / 0.05))[:, None] * path.velocities[k] / max(speed, 1e-6)
        if float(flight.world.distance(path.positions[k] + steps, 0.0).min()) < FlightRules().radius + aside:
            return True
    return False


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print a line for each flight and a summary of the endings; return 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.rig.fault_flights", description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="first seed (default 0)")
    parser.add_argument("--count", type=int, default=1000, help="number of flights (default 1000)")
    options = parser.parse_args(arguments)
    endings: dict[str, int] = {}
    failed = 0
    began = time.monotonic()
    for seed in range(options.seed, options.seed + options.count):
        flight = draw(seed)
        result = fly(flight)
        broken = broken_promises(flight, result)
        failed += bool(broken)
        end = ending(result)
        endings[end] = endings.get(end, 0) + 1
        figures = f"{result.flight_time_s:.1f} s, {result.min_clearance:.2f} m, loss {height_loss(result):.2f} m"
        print(f"{flight} | {end} after {figures}{''.join(' | BROKEN: ' + text for text in broken)}", flush=True)
    for end, number in sorted(endings.items(), key=lambda item: -item[1]):
        print(f"{number:5} {end}")
    print(f"{failed} of {options.count} flights broke a promise; {time.monotonic() - began:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        sys.exit(main())
