"""Changes of one parameter that are worth trying."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from aero_planner import PlannerConfig
from aero_planner.config import DroneConfig, Value

MOST = 3
"""Largest number of changes that are offered for one cause."""
_STAGES = "stages.active"
_SLOWER, _WIDER, _PROOF = (
    ("vehicle.speed_limit", 0.7),
    ("candidates.safe_clearance", 1.3),
    ("stop_proof.prove_stop", 1.0),
)
_REMEDIES: Mapping[str, Sequence[tuple[str, float]]] = {
    "moving obstacle": (("moving_obstacles.predict", 1.0), _SLOWER, _WIDER),
    "field of view": (("unseen_space.continuation", 2.0), _PROOF, _SLOWER, _WIDER),
    "occluded": (_PROOF, _SLOWER, ("unseen_space.continuation", 2.0), _WIDER),
    "forgotten": (("memory.memory_time", 2.0), ("memory.memory_distance", 1.5), _SLOWER),
    "beyond range": (("partition.range_max", 1.5), _SLOWER, _PROOF),
    "no ray hit it": (("memory.memory_time", 2.0), _SLOWER, _WIDER),
    "stopped too late": (_SLOWER, _WIDER, ("candidates.brake_reach", 0.8)),
    "counted as safe": (_WIDER, ("candidates.prefer_safe", 1.0), ("candidates.speed_margin", 2.0)),
    "no candidate was safe": (("candidates.safe_clearance", 0.85), ("way_out.spread", 1.3), _SLOWER),
    "the cheapest candidate was not safe": (("candidates.prefer_safe", 1.0), _SLOWER, ("way_out.spread", 1.3)),
    "the cloud was stale": (("partition.cloud_age_max", 2.0), _SLOWER),
    "every anchor is blocked": (("anchors.spacing", 1.4), ("way_out.spread", 1.3), ("anchors.lookahead", 0.7)),
    "the way to the goal is blocked": (("way_out.q_escape", 2.0), ("costs.q_blocked", 2.0), ("way_out.radius", 1.5)),
    "without coming nearer": (("way_out.q_escape", 2.0), ("way_out.patience", 0.5), ("costs.q_position", 1.5)),
    "out of time: coming nearer": (
        ("vehicle.speed_limit", 1.5),
        ("costs.q_position", 1.5),
        ("anchors.lookahead", 1.5),
    ),
    "left the world": (("costs.q_position", 1.5), _SLOWER),
}
"""What helps against a cause, by words of it: parameters with factors on their values; of a switch, on or off."""


@dataclass(frozen=True)
class Advice:
    """A change of one parameter that is worth trying."""

    path: str
    value: Value

    def text(self, config: DroneConfig) -> str:
        """Return the change in words."""
        old, new = config.get(self.path), self.value
        if self.path == _STAGES:
            return f"Switch on {str(new).rpartition(', ')[2]}".replace("_", " ")
        if isinstance(old, bool):
            return f"{config.find(self.path).title}: {'on' if new else 'off'}"
        return f"{config.find(self.path).title}: {old:g} → {new:g}"


def against(cause: str, config: DroneConfig) -> list[Advice]:
    """Return what to try against the cause of a failure, see `PostMortem.cause`; of AERO-MPPI's parameters only."""
    if not isinstance(config, PlannerConfig):
        return []
    found: dict[str, Advice] = {}
    for words, remedies in _REMEDIES.items():
        for path, factor in remedies if words in cause else ():
            advice = _with_stage(path, config) or _scaled(path, factor, config)
            if advice is not None:
                found.setdefault(advice.path, advice)
    return list(found.values())[:MOST]


def _with_stage(path: str, config: PlannerConfig) -> Advice | None:
    """Return the change that activates the stage of a parameter; None if it is active, or none has it."""
    stage, active = path.partition(".")[0], config.stages.names
    is_missing = stage in (config.find(_STAGES).items or ()) and stage not in active
    return Advice(_STAGES, ", ".join([*active, stage])) if is_missing else None


def _scaled(path: str, factor: float, config: PlannerConfig) -> Advice | None:
    """Return a change by a factor, or to the default if that goes farther; None where it changes nothing."""
    info, old = config.find(path), config.get(path)
    if isinstance(old, bool):
        value: Value = factor > 0.0
    else:
        end = max if factor > 1.0 else min
        wanted = end(factor * float(old), float(info.default))
        value = float(f"{min(max(wanted, info.low), info.high):.3g}")
    try:
        return None if config.replace({path: value}) == config else Advice(path, value)
    except ValueError:  # it contradicts another parameter
        return None
