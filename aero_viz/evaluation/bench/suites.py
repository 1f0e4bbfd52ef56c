"""The definitions of all benchmarks: their worlds, speeds and configurations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from aero_planner.config import PlannerConfig, Value
from aero_viz.evaluation.bench.sudden_object import SuddenObject, open_field
from aero_viz.scenes import World

PUBLISHED_SPEED = 7.0
"""Highest velocity limit of the paper [m/s], at which planners are compared."""


@dataclass(frozen=True)
class Row:
    """One row of a table: flights that differ only in their worlds."""

    label: str
    """Unique within its benchmark."""
    scene: str
    count: int | None = None
    """Number of obstacles; None uses the scene's default."""
    speed: float = PUBLISHED_SPEED
    """vehicle.speed_limit [m/s]."""
    lidar: str = "mid360"
    """Name of the LiDAR model."""
    preset: str | None = None
    """Preset to use in place of the configuration that the user chose."""
    changes: Mapping[str, Value] = field(default_factory=dict)
    """Changed parameters, by path."""
    arrival_radius: float | None = None
    """Distance to the goal that counts as arrival [m]; None uses that of the flight's rules."""
    batch: int | None = None
    """Number of flights, all in one batch; None leaves both numbers to the user."""
    series: str = ""
    """Curve of the plot that the row belongs to."""
    x: float | None = None
    """Position on the horizontal axis of the plot."""
    published: str | None = None
    """Scene of the paper's table that the row is compared with."""
    target: tuple[float, float | None] | None = None
    """Success rate and mean speed [m/s] to reach."""
    sha256: str | None = None
    """Checksum of the file of the row's world; None for a scene."""
    sudden: SuddenObject | None = None
    """Object that appears during the flight."""

    @property
    def world_kind(self) -> str:
        """Name of the row's worlds without the seed."""
        if self.sha256 is not None:
            return self.label
        return self.scene if self.count is None else f"{self.scene}-{self.count}"


@dataclass(frozen=True)
class Benchmark:
    """A table or figure."""

    name: str
    title: str
    note: str
    """Introduction of the report, in Markdown."""
    rows: tuple[Row, ...]
    x_label: str = ""
    """Label of the horizontal axis; if empty, the plot has bars."""
    first_seed: int = 0
    """Added to the user's seed."""
    metric: Literal["success", "throughput"] = "success"
    """Metric to plot."""
    worlds: Mapping[str, World] = field(default_factory=dict)
    """Worlds that are not generated, by the label of their row; the other rows fly through scenes."""


_GROUND_KNOWN: dict[str, Value] = {"costs.use_ground": True}
_GROUND_UNKNOWN: dict[str, Value] = {"costs.use_ground": False}
"""The planner does not know the height of the ground, which a Mid-360 does not see: it looks only 7 degrees down."""

_FIELDS = (("forest", 100), ("verticals", 300), ("inclines", 800))


def _table2() -> Benchmark:
    scenes = (("forest", "forest", 100), ("verticals 1000", "verticals", 1000), ("verticals 300", "verticals", 300),
              ("inclines", "inclines", 800))  # fmt: skip
    return Benchmark(
        "table2",
        "Comparison with published planners",
        "The paper's text gives 1000 verticals with radii of 0.4 to 1.1 m, which leave no path for any drone. The "
        "scenes use these numbers as widths. About 300 of them give the paper's mean clearance. Both are listed.",
        tuple(
            Row(f"{label}{suffix}", scene, count, changes=changes, published=scene)
            for suffix, changes in (("", _GROUND_UNKNOWN), (", ground known", _GROUND_KNOWN))
            for label, scene, count in scenes
        ),
    )


def _success() -> Benchmark:
    rows = [
        Row(
            f"{scene} {speed} m/s",
            scene,
            count,
            speed=float(speed),
            changes=_GROUND_KNOWN,
            series=f"{scene} {count}",
            x=float(speed),
        )
        for scene, count in _FIELDS
        for speed in range(1, 8)
    ]
    return Benchmark(
        "success",
        "Success over the velocity limit",
        "300 verticals instead of the 1000 of the paper's text, as explained in `table2`. At 1 m/s a flight needs 45 "
        "of its 60 s. The planner knows the height of the ground; the Mid-360 does not see it, and slow flights would "
        "sink.",
        tuple(rows),
        x_label="velocity limit [m/s]",
    )


def _density() -> Benchmark:
    kinds = (("density", "heights 1 to 6 m"), ("density-6m", "heights 6 m"))
    rows = [
        Row(f"{count} obstacles, {name}", scene, count, changes=_GROUND_KNOWN, series=name, x=float(count))
        for scene, name in kinds
        for count in (200, 400, 600, 800, 1000)
    ]
    return Benchmark(
        "density",
        "Success and speed over the number of obstacles",
        "Vertical cylinders 0.4 to 1.1 m wide. For the same seed, those of random and of fixed height have the same "
        "positions and widths. The planner knows the height of the ground.",
        tuple(rows),
        x_label="obstacles",
    )


def _rooms() -> Benchmark:
    rooms = ("pillars", "wall", "double_wall_trap", "random_clutter")
    return Benchmark(
        "rooms",
        "Indoor rooms",
        "The paper shows the four rooms but gives neither their dimensions nor the speed. Here the velocity limit is "
        "2 m/s, and a flight arrives within 0.5 m of the goal, which is 3.75 m away.",
        tuple(
            Row(f"{room}{suffix}", room, speed=2.0, changes=changes, arrival_radius=0.5)
            for suffix, changes in (("", _GROUND_UNKNOWN), (", ground known", _GROUND_KNOWN))
            for room in rooms
        ),
    )


def _without(name: str, stages: Sequence[str]) -> str:
    return ", ".join(stage for stage in stages if stage != name)


def _ablation() -> Benchmark:
    single: dict[str, Value] = {"anchors.columns": 1, "anchors.rows": 1}
    alone: dict[str, Value] = {"candidates.previous": False}
    stages = PlannerConfig().stages.names
    variants: list[tuple[str, dict[str, Value]]] = [
        ("as configured", {}),
        ("M = 1: one MPPI and no other candidate", single | alone),
        ("one anchor, with previous", single),
        *((f"K = {k}", {"sampling.samples": k}) for k in (32, 64, 128, 256)),
        *((f"N = {n}", {"sampling.steps": n}) for n in (15, 20, 25, 30, 35)),
        ("no previous plan", alone),
        *((f"without the stage {name}", {"stages.active": _without(name, stages)}) for name in stages),
        ("surfaces continued from the present view", {"unseen_space.view_age": 0.0}),
        ("no wider spread when slow", {"way_out.spread": 1.0}),
        ("drag not estimated", {"disturbance.drag_time": 0.0}),
        ("white noise", {"sampling.correlation": 0.0}),
        ("best sample alone", {"sampling.effective_samples": 1.0}),
        ("jumps of the thrust are free", {"costs.q_thrust_jump": 0.0}),
        ("no cost-to-go", {"costs.q_blocked": 0.0}),
        ("no price on excess speed", {"costs.q_speed": 0.0}),
        ("no margin per speed", {"candidates.speed_margin": 0.0}),
        ("the delay is not known", {"vehicle.delay": 0.0001}),  # 0 would be replaced by that of the drone
        ("the paper's tracking weight", {"costs.q_track": 15.0}),
        ("the paper's distances, 0.4 and 1.0 m", {"costs.distance_min": 0.4, "costs.distance_max": 1.0}),
        ("the paper's exponential penalty", {"costs.shape": "exponential", "costs.penalty": 1e6}),
    ]
    variants.append(("ground unknown", _GROUND_UNKNOWN))
    rows = [Row(label, "inclines", 800, changes=_GROUND_KNOWN | changes) for label, changes in variants]
    rows.insert(1, Row("the paper's preset", "inclines", 800, preset="paper", changes=_GROUND_KNOWN))
    return Benchmark(
        "ablation",
        "Contribution of each mechanism",
        "800 inclines; the planner knows the height of the ground. All rows fly in the same worlds. Each row changes "
        "the first one as its label says; the delay matters only for a drone with a latency or a lag of its rates.",
        tuple(rows),
    )


def _default() -> Benchmark:
    targets: dict[tuple[str, int], tuple[float, float | None]] = {
        ("forest", 100): (0.98, 5.6),
        ("verticals", 300): (0.95, None),
        ("inclines", 400): (0.98, None),
        ("inclines", 800): (0.85, 5.0),
    }
    kinds: tuple[tuple[str, str, dict[str, Value]], ...] = (
        ("full-sphere", "full-sphere", _GROUND_UNKNOWN),
        ("mid360", "mid360", _GROUND_UNKNOWN),
        ("mid360, ground known", "mid360", _GROUND_KNOWN),
    )
    rows = [
        Row(
            f"{scene} {count}, {kind}",
            scene,
            count,
            lidar=lidar,
            changes=changes,
            series=kind,
            target=target if lidar == "full-sphere" else None,
        )
        for kind, lidar, changes in kinds
        for (scene, count), target in targets.items()
    ]
    return Benchmark(
        "default",
        "Acceptance of the default configuration",
        "Seeds from 10 000 on, which were never used for tuning. The targets are for a LiDAR with a full spherical "
        "field of view; the Mid-360 sees only down to 7 degrees below the horizon.",
        tuple(rows),
        first_seed=10_000,
    )


def _scaling() -> Benchmark:
    rows = [
        Row(
            f"batch {batch}",
            "forest",
            100,
            batch=batch,
            changes=_GROUND_UNKNOWN,
            series="flights per minute",
            x=float(batch),
        )
        for batch in (1, 16, 64, 256, 1024)
    ]
    return Benchmark(
        "scaling",
        "Flights per minute over the batch size",
        "Time from the first tick to the end of the slowest flight. Building worlds and buffers is listed separately.",
        tuple(rows),
        x_label="flights in a batch",
        metric="throughput",
    )


def _sudden() -> Benchmark:
    rows, worlds = [], {}
    for distance in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0):
        for speed in (0.5, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0):
            label = f"{distance:g} m at {speed:g} m/s"
            worlds[label], run_up = open_field(speed)
            sudden = SuddenObject(run_up, distance)
            series = f"appears at {distance:g} m"
            rows.append(
                Row(label, "open-field", speed=speed, changes=_GROUND_KNOWN, series=series, x=speed, sudden=sudden)
            )
    return Benchmark(
        "sudden",
        "An object that suddenly appears",
        "The test of IPC (Liu, Ren and Zhang, RA-L 2023): in an open field, an object of 0.2 x 0.2 x 3 m appears in "
        "front of the drone, up to 0.1 m to its left or right, by seed. The distance is that from the centre of the "
        "drone to the front of the object. The planner knows the height of the ground. A flight succeeds if it goes on "
        "to the goal without contact.",
        tuple(rows),
        x_label="velocity limit [m/s]",
        worlds=worlds,
    )


def _moving() -> Benchmark:
    kinds = [("moving", 20, "pillars"), ("moving", 40, "pillars"), ("moving", 60, "pillars")]
    kinds.append(("fast_moving", 20, "fast pillars"))
    rows = [
        Row(
            f"{count} {pillars} at {speed} m/s",
            scene,
            count,
            speed=float(speed),
            changes=_GROUND_KNOWN,
            series=f"{count} {pillars}",
            x=float(speed),
        )
        for scene, count, pillars in kinds
        for speed in (1, 3, 5, 7)
    ]
    return Benchmark(
        "moving",
        "Moving obstacles",
        "Pillars, 0.4 to 1.1 m wide, move back and forth over 5 to 15 m at 0.5 to 2 m/s, fast ones at up to 6 m/s, "
        "between and next to start and goal. They do not yield, so that one may hit a drone at rest. The planner "
        "estimates their motion, and knows the height of the ground.",
        tuple(rows),
        x_label="velocity limit [m/s]",
    )


_ALL = (_table2(), _success(), _density(), _rooms(), _ablation(), _default(), _sudden(), _moving(), _scaling())
BENCHMARKS: dict[str, Benchmark] = {benchmark.name: benchmark for benchmark in _ALL}
"""All benchmarks, by name."""
