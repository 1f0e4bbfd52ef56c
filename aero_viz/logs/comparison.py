"""The comparison of two flight logs: figures, parameters and conditions, in one time base."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_planner import PlannerConfig, PlanStatus
from aero_planner.config import DroneConfig
from aero_viz.errors import UserError
from aero_viz.logs.flight_figures import CLEARANCE_MAX, LABELS, FlightFigures
from aero_viz.logs.log_contents import LogContents, is_flight_log, read_log
from aero_viz.nested_values import leaves_by_path
from aero_viz.scenes import World
from aero_viz.text_table import format_table

_logger = logging.getLogger(__name__)

_SAME = 0.01
"""Positions that differ by less than this count as equal, because logs of drones are noisy [m]."""


@dataclass(frozen=True, eq=False)
class LoggedFlight:
    """Flight in a log: one value for each plan, in the order of time."""

    name: str
    """Name of the file."""
    columns: Mapping[str, NDArray[np.float64]]
    """"time" since the first pose [s], "speed" [m/s], "clearance" [m], costs of the chosen instance "cost", "goal_cost"
    and "collision_cost", "plan_ms", number of candidates with the safe clearance "clear", "unsafe" (1 if no candidate
    was safe), number of the "best" instance, and "x", "y", "z" [m].

    The clearance is the distance to the obstacles of the world; without a world, that of the plan to the cloud."""
    outcome: str
    config: DroneConfig
    """Configuration of the last plan."""
    conditions: Mapping[str, Any]
    """Planner; seed, LiDAR, drone, noise and rules of a simulated flight, and the checksum of its world, by path."""

    @classmethod
    def read(cls, path: str | Path) -> LoggedFlight:
        """Read a flight log.

        Raises:
            UserError: the file is not a flight log, or is damaged; says which file and what to give instead.
        """
        if not Path(path).exists():
            raise UserError(f"There is no file {path}; give two flight logs (MCAP).")
        if not is_flight_log(path):
            raise UserError(
                f"{path} is not a flight log with plans; write one with `aero-viz fly .. --log FLIGHT.mcap`, or use "
                "that of the drone."
            )
        contents = read_log(path)
        try:
            return _flight(Path(path), contents)
        except UserError:
            raise
        except Exception as error:  # damaged numbers can fail anywhere
            raise UserError(f"{path} cannot be read: {error}. It may be cut short or damaged.") from error


@dataclass(frozen=True, eq=False)
class LogComparison:
    """Two flights, A and B."""

    a: LoggedFlight
    b: LoggedFlight

    @property
    def differs_at(self) -> float | None:
        """Time from which B is more than 1 cm from where A was [s]; None if it never is."""
        a, b = self.a.columns, self.b.columns
        shared = b["time"] <= a["time"][-1] + 1e-9
        apart = [np.abs(b[axis][shared] - np.interp(b["time"][shared], a["time"], a[axis])) for axis in "xyz"]
        rows = np.flatnonzero(np.max(apart, axis=0) > _SAME) if shared.any() else []
        return float(b["time"][rows[0]]) if len(rows) else None

    @property
    def figures(self) -> tuple[FlightFigures, FlightFigures]:
        """Figures of A and B."""
        a, b = (FlightFigures.from_columns(flight.columns, flight.outcome) for flight in (self.a, self.b))
        return a, b

    @property
    def conditions(self) -> dict[str, tuple[Any, Any]]:
        """Values of each condition that differs."""
        a, b = self.a.conditions, self.b.conditions
        return {path: (a.get(path), b.get(path)) for path in {**a, **b} if a.get(path) != b.get(path)}

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        a, b = self.figures
        return {
            "a": {"file": self.a.name, **a.to_dict()},
            "b": {"file": self.b.name, **b.to_dict()},
            "differs_at_s": self.differs_at,
            "parameters": _pairs(self.a.config.differences(self.b.config)),
            "conditions": _pairs(self.conditions),
        }

    def format_table(self) -> str:
        """Return the comparison as text."""
        a, b = self.figures
        rows = [list(row) for row in zip(LABELS, a.texts(), b.texts(), strict=True)]
        lines = [f"A: {self.a.name}", f"B: {self.b.name}", ""]
        lines += [format_table(rows, header=("flight", "A", "B"), right=(1, 2)), ""]
        differs_at = self.differs_at
        lines += ["The paths do not differ." if differs_at is None else f"The paths differ from {differs_at:.2f} s on."]
        parameters = self.a.config.differences(self.b.config)
        for name, pairs in (("parameter", parameters), ("condition", self.conditions)):
            if pairs:
                cells = [[path, f"{old}", f"{new}"] for path, (old, new) in pairs.items()]
                lines += ["", format_table(cells, header=(name, "A", "B"), right=(1, 2))]
            else:
                lines += ["", f"No {name} differs."]
        lines += ["", "These are single flights; aero-viz bench compare says whether many differ significantly."]
        return "\n".join(lines)


def compare_logs(a: str | Path, b: str | Path) -> LogComparison:
    """Return the comparison of two flight logs.

    Raises:
        UserError: a file is not a flight log, or is damaged.
    """
    return LogComparison(LoggedFlight.read(a), LoggedFlight.read(b))


def _flight(path: Path, contents: LogContents) -> LoggedFlight:
    if not contents.poses or not contents.plans:
        raise UserError(f"{path} holds no poses or no plans, so that there is nothing to compare.")
    if contents.damage:
        _logger.warning("%s: %s", path, contents.damage)
    world, config = contents.world(), contents.config(contents.plans[-1].config_version)
    if config is None:
        raise UserError(f"{path} holds no configuration, so that it cannot be compared; give a log with one.")
    settings = contents.settings()
    if world is not None:
        settings["world"] = hashlib.sha256(contents.attachments["world.json"]).hexdigest()[:12]
    return LoggedFlight(
        name=path.name,
        columns=_columns(contents, world, config),
        outcome=contents.outcome or "cut short",
        config=config,
        conditions=leaves_by_path({"planner": config.planner, **settings}),
    )


def _columns(contents: LogContents, world: World | None, config: DroneConfig) -> dict[str, Any]:
    stamps, plans = contents.pose_stamps, [plan for plan in contents.plans if plan.kinds]
    start, table = stamps[0], np.array(contents.poses)
    time = np.array([(plan.stamp - start) * 1e-9 for plan in plans])
    pose_times = np.array([(stamp - start) * 1e-9 for stamp in stamps])
    columns = {
        name: np.interp(time, pose_times, values)
        for name, values in zip(("x", "y", "z", "speed"), table.T, strict=True)
    }
    for name in ("stage2_cost", "goal_cost", "collision_cost"):
        columns[name.replace("stage2_", "")] = np.array([float(getattr(plan, name)[plan.best]) for plan in plans])
    if world is not None:
        columns["clearance"] = world.distance(np.stack([columns[axis] for axis in "xyz"], axis=1), time)
    else:
        columns["clearance"] = np.array([float(plan.clearance[plan.best]) for plan in plans])
    limit = config.candidates.safe_clearance if isinstance(config, PlannerConfig) else np.inf
    return columns | {
        "time": time,
        "clearance": columns["clearance"].clip(0.0, CLEARANCE_MAX),
        "plan_ms": np.array([plan.plan_ms for plan in plans]),
        "clear": np.array([float(np.count_nonzero(plan.clearance >= limit)) for plan in plans]),
        "unsafe": np.array([float(plan.status == PlanStatus.NO_SAFE_CANDIDATE) for plan in plans]),
        "best": np.array([float(plan.best) for plan in plans]),
    }


def _pairs(values: Mapping[str, tuple[Any, Any]]) -> dict[str, dict[str, Any]]:
    return {name: {"a": a, "b": b} for name, (a, b) in values.items()}
