"""The comparison of two runs of a benchmark through the same worlds: two configurations or versions of the planner."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aero_viz.errors import UserError
from aero_viz.evaluation.bench.result_folder import read_folder
from aero_viz.nested_values import leaves_by_path
from aero_viz.statistics import PairedComparison, wilson_interval
from aero_viz.text_table import format_table

_SAME = ("benchmark", "seed", "lidar", "simulation")
"""Keys of the header that must be equal, because the worlds or the flights depend on them besides the planner."""

_HEADER = (
    "row",
    "worlds",
    "A arrives",
    "B arrives",
    "only A",
    "only B",
    "p",
    "A faster",
    "B faster",
    "p",
    "B slower by",
    "better",
)


@dataclass(frozen=True)
class _Flight:
    """Fields of a flight that are compared."""

    arrived: bool
    flight_time_s: float


@dataclass(frozen=True)
class RunComparison:
    """Two runs of the same benchmark."""

    rows: dict[str, PairedComparison]
    """Comparison by row, and over all rows as "all"."""
    differences: dict[str, tuple[Any, Any]]
    """Parameters and versions that differ, with the values of A and B."""
    unpaired: int
    """Number of flights that only one of the two runs has."""

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        return {
            "rows": {label: paired.to_dict() for label, paired in self.rows.items()},
            "differences": {name: {"a": a, "b": b} for name, (a, b) in self.differences.items()},
            "unpaired": self.unpaired,
        }

    def format_table(self) -> str:
        """Return the differences and one line per row as text."""
        lines = [f"{name}: A {a}, B {b}" for name, (a, b) in self.differences.items()] or ["A and B do not differ."]
        cells = [[label, *_cells(paired)] for label, paired in self.rows.items()]
        lines += ["", format_table(cells, header=_HEADER, right=range(1, len(_HEADER) - 1))]
        lines.append(
            "p: two-sided sign test over the worlds. In brackets: 95 % interval. Better: p is at most 5 %, by "
            "arrivals, else by flight times."
        )
        if any(paired.flights > paired.pairs for paired in self.rows.values()):
            lines.append(
                "Worlds are flown several times: only A are those in which A arrives more often, and A is faster "
                "where its mean time over the flights that both arrive is shorter. Intervals of arrivals are over "
                "flights."
            )
        if self.unpaired:
            lines.append(f"{self.unpaired} flights were left out, because only one of the two runs has them.")
        return "\n".join(lines)


def compare_runs(folder_a: str | Path, folder_b: str | Path) -> RunComparison:
    """Return the comparison of the runs in two folders of results, over the flights that both have.

    Raises:
        UserError: a folder holds no results, the runs are not of the same worlds, or no flight is in both.
    """
    (header_a, flights_a), (header_b, flights_b) = read_run(folder_a), read_run(folder_b)
    check_same(folder_a, header_a, folder_b, header_b)
    keys = [key for key in flights_a if key in flights_b]
    if not keys:
        raise UserError(f"{folder_a} and {folder_b} have no flight through the same world.")
    labels = [*dict.fromkeys(row for row, *_ in keys), "all"]
    files = {row["label"] for row in header_a.get("rows", ()) if row.get("sha256")}
    rows = {}
    for label in labels if len(labels) > 2 else labels[:1]:
        members = [key for key in keys if label in (key[0], "all")]
        # The file of a row is the same world whatever the seed.
        worlds = [(row, None if row in files else seed) for row, _, seed in members]
        rows[label] = PairedComparison.from_flights(
            [flights_a[key] for key in members], [flights_b[key] for key in members], worlds
        )
    return RunComparison(rows, _differences(header_a, header_b), len(flights_a) + len(flights_b) - 2 * len(keys))


def check_same(folder_a: str | Path, a: dict[str, Any], folder_b: str | Path, b: dict[str, Any]) -> None:
    """Raise a UserError unless two runs, by their headers, are of the same worlds, drone and LiDAR."""
    for key in _SAME:
        if a[key] != b[key]:
            raise UserError(
                f"{folder_a} and {folder_b} cannot be compared: {key} is {a[key]!r} in one and {b[key]!r} in the "
                "other; fly both with the same worlds, drone and LiDAR."
            )


def read_run(folder: str | Path) -> tuple[dict[str, Any], dict[tuple[str, int, int], _Flight]]:
    """Return the header of a run and its flights by row, index and seed of the world."""
    header, flights = read_folder(Path(folder))
    if header is None:
        raise UserError(f"{folder} holds no results; give a folder that `aero-viz bench` wrote, like results/table2.")
    return header, {(f["row"], f["index"], f["world_seed"]): _Flight(f["arrived"], f["flight_time_s"]) for f in flights}


def _differences(header_a: dict[str, Any], header_b: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return the values of A and B that differ and have an effect, by name."""
    tables = [{row["label"]: row for row in header.get("rows", ())} for header in (header_a, header_b)]
    rows = [row for table in tables for row in table.values()]
    found: dict[str, tuple[Any, Any]] = {}
    planners = tuple(header.get("planner", "aero_mppi") for header in (header_a, header_b))
    if planners[0] != planners[1]:
        found["planner"] = planners[0], planners[1]
    for key in ("config", "versions", "device", "rows"):
        contents = tables if key == "rows" else (header_a[key], header_b[key])
        values_a, values_b = (leaves_by_path(content, key) for content in contents)
        names = {**values_a, **values_b}
        if key == "config" and "planner" in found:
            names = {name: None for name in values_a if name in values_b}
        found.update({n: (values_a.get(n), values_b.get(n)) for n in names if values_a.get(n) != values_b.get(n)})
    return {name.removeprefix("config."): values for name, values in found.items() if _has_effect(name, rows)}


def _has_effect(name: str, rows: list[dict[str, Any]]) -> bool:
    """Return False for a parameter that all rows set themselves, as they do the speed limit."""
    path = name.removeprefix("config.")
    return (
        path == name
        or not rows
        or any(
            row.get("preset") is None and path not in ("vehicle.speed_limit", *row.get("changes", ())) for row in rows
        )
    )


def _cells(paired: PairedComparison) -> list[str]:
    def share(arrived: int) -> str:
        low, high = wilson_interval(arrived, paired.flights)
        return f"{100.0 * arrived / paired.flights:.0f} % ({100.0 * low:.0f} to {100.0 * high:.0f})"

    return [
        str(paired.pairs),
        share(paired.arrived_a),
        share(paired.arrived_b),
        str(paired.only_a),
        str(paired.only_b),
        f"{paired.p_arrival:.2g}",
        str(paired.faster_a),
        str(paired.faster_b),
        f"{paired.p_time:.2g}",
        "-" if paired.slower_by_s is None else "{:.2f} s ({:.2f} to {:.2f})".format(*paired.slower_by_s),
        paired.verdict,
    ]
