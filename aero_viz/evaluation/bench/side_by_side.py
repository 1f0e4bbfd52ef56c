"""Several runs of a benchmark side by side, such as those of several planners through the same worlds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aero_viz.evaluation.bench.comparison import RunComparison, check_same, compare_runs, read_run
from aero_viz.evaluation.bench.result_folder import read_folder
from aero_viz.statistics import Summary, summarise
from aero_viz.text_table import format_table

_HEADER = (
    "row", "run", "planner", "arrives", "time [s]", "speed [m/s]", "smoothness [m²/s⁵]", "clearance [m]", "plan [ms]",
    "better than the first",
)  # fmt: skip


@dataclass(frozen=True)
class SideBySide:
    """Runs of the same benchmark, over the flights that all of them have."""

    planners: tuple[str, ...]
    """Planner of each run."""
    rows: dict[str, tuple[Summary, ...]]
    """Figures of each run by row."""
    comparisons: tuple[RunComparison, ...]
    """Comparison of the first run with each of the others."""

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        runs = [
            {**summary.to_dict(), "run": summary.planner, "planner": planner}
            for row, summaries in self.rows.items()
            for planner, summary in zip(self.planners, summaries, strict=True)
        ]
        return {"runs": runs, "comparisons": [comparison.to_dict() for comparison in self.comparisons]}

    def format_table(self) -> str:
        """Return one line per row and run as text."""
        cells = []
        for row, summaries in self.rows.items():
            for k, (planner, one) in enumerate(zip(self.planners, summaries, strict=True)):
                verdict = "" if k == 0 else _verdict(self.comparisons[k - 1], row)
                cells.append([row if k == 0 else "", one.planner, planner, *_figures(one), verdict])
        table = format_table(cells, header=_HEADER, right=range(3, len(_HEADER) - 1))
        return f"{table}\nMeans are over the flights that arrive. Better: by a sign test over the worlds, at 5 %."


def compare_side_by_side(folders: Sequence[str | Path]) -> SideBySide:
    """Return runs of the same benchmark side by side, in the order of their folders.

    Raises:
        UserError: a folder holds no results, the runs are not of the same worlds, or no flight is in all of them.
    """
    headers = [read_run(folder)[0] for folder in folders]
    for folder, header in zip(folders[1:], headers[1:], strict=True):
        check_same(folders[0], headers[0], folder, header)
    comparisons = tuple(compare_runs(folders[0], folder) for folder in folders[1:])
    runs = [{(f["row"], f["index"], f["world_seed"]): f for f in read_folder(Path(folder))[1]} for folder in folders]
    shared = [key for key in runs[0] if all(key in run for run in runs)]
    labels = list(dict.fromkeys(row for row, *_ in shared))
    rows = {
        label: tuple(
            summarise([run[key] for key in shared if label in (key[0], "all")], row=label, planner=Path(folder).name)
            for folder, run in zip(folders, runs, strict=True)
        )
        for label in (*labels, *(["all"] if len(labels) > 1 else []))
    }
    return SideBySide(tuple(header.get("planner", "aero_mppi") for header in headers), rows, comparisons)


def _figures(one: Summary) -> list[str]:
    means = [one.mean[name] for name in ("flight_time_s", "mean_speed", "smoothness", "min_clearance")]
    interval = f"{100.0 * one.success_low:.0f} to {100.0 * one.success_high:.0f}"
    texts = ["-" if mean is None else f"{mean:.4g}" for mean in means]
    return [f"{100.0 * one.success_rate:.0f} % ({interval})", *texts, f"{one.plan_ms_median or 0.0:.1f}"]


def _verdict(comparison: RunComparison, row: str) -> str:
    paired = comparison.rows.get(row)
    return "" if paired is None else {"A": "no, worse", "B": "yes", "noise": "not significantly"}[paired.verdict]
