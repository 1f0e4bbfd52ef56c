"""The stage that tracks and predicts dynamic obstacles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import warp as wp

from aero_planner.array_memory import array
from aero_planner.config import PlannerConfig
from aero_planner.device.records import bundle
from aero_planner.kernels.sweep_change import RECENT
from aero_planner.plan import MovingObstacles
from aero_planner.recorder import Recorder
from aero_planner.stage import Hooks, Launches, Stage
from aero_planner.stages.moving_obstacles import giving_way, segments, tracks
from aero_planner.stages.moving_obstacles.segments import BINS, BLOCK, TRACKS
from aero_planner.stages.moving_obstacles.tracks import STARTS

_BINS, _BLOCKS, _TRACKS, _RECENT = int(BINS), int(BINS) // int(BLOCK), int(TRACKS), int(RECENT)
_STARTS = int(STARTS)


@dataclass(eq=False)
class Arrays:
    """Scans of the recent sweeps, what they show, and the tracks that follow from them."""

    scan: wp.array = array(
        wp.int32, f"B {_RECENT} {_BINS + _BLOCKS}", "",
        "Nearest range of each bin of the recent sweeps, as an integer; then the number of circles of each block.",
    )  # fmt: skip
    circle_center: wp.array = array(
        wp.vec2,
        f"B {_RECENT} {_BINS}",
        "m",
        "Centre of the circle of the segment that begins at each bin.",
    )
    circle_radius: wp.array = array(wp.float32, f"B {_RECENT} {_BINS}", "m", "Radius of this circle; 0 for none.")
    segment_count: wp.array = array(wp.int32, f"B {_RECENT}", "", "Number of segments of each of these sweeps.")
    segment_center: wp.array = array(wp.vec2, f"B {_RECENT} {_TRACKS}", "m", "Centres of their circles, world frame.")
    segment_radius: wp.array = array(wp.float32, f"B {_RECENT} {_TRACKS}", "m", "Radii of their circles.")
    found_position: wp.array = array(
        wp.vec2, f"B {_STARTS} {_TRACKS}", "m", "Axes of segments that move, by the sweep last seen in."
    )
    found_velocity: wp.array = array(wp.vec2, f"B {_STARTS} {_TRACKS}", "m/s", "Their velocities, world frame.")
    found_radius: wp.array = array(wp.float32, f"B {_STARTS} {_TRACKS}", "m", "Their radii; -1 for none.")
    track_time: wp.array = array(
        wp.float64,
        "B",
        "s",
        "When the tracks are where they are; NaN: unknown.",
        kept="sweeps",
        initial=math.nan,
    )
    track_count: wp.array = array(wp.int32, "B", "", "Number of tracks.", kept="sweeps")
    track_position: wp.array = array(wp.vec2, f"B {_TRACKS}", "m", "Their axes, world frame.")
    track_velocity: wp.array = array(wp.vec2, f"B {_TRACKS}", "m/s", "Their velocities, world frame.")
    track_radius: wp.array = array(wp.float32, f"B {_TRACKS}", "m", "Their radii.")


@dataclass(eq=False)
class Outputs:
    """Dynamic obstacles at the start of the plan."""

    dynamic_count: wp.array = array(wp.int32, "B", "", "Number of dynamic obstacles.")
    dynamic_position: wp.array = array(wp.vec2, f"B {_TRACKS}", "m", "Their axes, world frame.")
    dynamic_velocity: wp.array = array(wp.vec2, f"B {_TRACKS}", "m/s", "Their velocities, world frame.")
    dynamic_radius: wp.array = array(wp.float32, f"B {_TRACKS}", "m", "Their radii.")


def _track(r: Recorder) -> list[list[Launches]]:
    """Track dynamic obstacles from the sweep that arrives and those before it."""
    a, B = r.stage_arrays("moving_obstacles"), r.sizes.B
    circles = bundle(segments.Circles, center=a.circle_center, radius=a.circle_radius, count=a.scan[:, :, _BINS:])
    listed = bundle(segments.Segments, count=a.segment_count, center=a.segment_center, radius=a.segment_radius)
    found = bundle(tracks.FoundTracks, position=a.found_position, velocity=a.found_velocity, radius=a.found_radius)
    sources = [r.change, r.sweeps, r.params, a.scan]
    launches = [
        a.scan.zero_,
        r.record(
            segments.scan_obstacles,
            (B, _RECENT, r.threads_per_sweep),
            inputs=[r.threads_per_sweep, r.change, r.problem, r.sweeps, r.params],
            outputs=[a.scan],
        ),
        r.record(segments.find_segments, (B, _RECENT, _BINS), inputs=sources, outputs=[circles]),
        r.record(segments.list_segments, (B, _RECENT, _BINS), inputs=[circles], outputs=[listed]),
        r.record(tracks.follow_segments, (B, _STARTS, _TRACKS), inputs=[*sources, listed], outputs=[found]),
        r.record(tracks.merge_tracks, (B,), inputs=[r.change, r.sweeps, found], outputs=[_tracks(r)]),
    ]
    return [[launches]]


def _place(r: Recorder) -> list[list[Launches]]:
    inputs = [r.problem, r.params, _tracks(r)]
    obstacles = r.bind(tracks.DynamicObstacles, "moving_obstacles")
    launch = r.record(tracks.place_obstacles, (r.sizes.B,), inputs=inputs, outputs=[obstacles])
    return [[[launch]]]


def _tracks(r: Recorder) -> object:
    return r.bind(tracks.Tracks, "moving_obstacles")


def _moving(values: Any, config: PlannerConfig, batched: bool) -> MovingObstacles | None:
    """Return the dynamic obstacles; None for a batch."""
    count = int(values["dynamic_count"][0])
    names = ("dynamic_position", "dynamic_velocity", "dynamic_radius")
    return None if batched else MovingObstacles(*(values[name][0, :count] for name in names))


STAGE = Stage(
    name="moving_obstacles",
    label="Moving obstacles",
    arrays=Arrays,
    outputs=Outputs,
    reports={"moving": _moving},
    view=giving_way.MovingObstacles,
    hooks=Hooks(ghost=tracks.is_ghost, clearance=tracks.clear_of_obstacles, admissible=giving_way.gives_way),
    launches={"arrival": _track, "beside": _place},
)
