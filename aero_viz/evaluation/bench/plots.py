"""Plots of a benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aero_viz.evaluation.bench.published_results import PUBLISHED
from aero_viz.evaluation.bench.suites import Benchmark
from aero_viz.evaluation.statistics import Summary

__all__ = ["plot"]

_SIZE, _DPI = (8.0, 4.5), 150


def plot(benchmark: Benchmark, summaries: Sequence[Summary], folder: Path, *, subtitle: str, ours: str) -> list[Path]:
    """Draw the plots of a benchmark and return the PNG files.

    Args:
        benchmark: the benchmark.
        summaries: rows of its table, including those of other planners.
        folder: folder of the files.
        subtitle: second line of each title.
        ours: name of our planner in `summaries`.
    """
    own = [line for line in summaries if line.planner == ours]
    external = [line for line in summaries if line.planner != ours]
    if benchmark.metric == "throughput":
        return [_throughput(benchmark, own, folder / "throughput.png", subtitle)]
    if benchmark.x_label:
        return [
            _curves(benchmark, own, external, folder / "success.png", subtitle, "success rate"),
            _curves(benchmark, own, external, folder / "speed.png", subtitle, "speed of arrived flights [m/s]"),
        ]
    files = [_bars(summaries, folder / "success.png", f"{benchmark.title}\n{subtitle}", ours)]
    if any(row.published for row in benchmark.rows):
        files.append(_speed_bars(benchmark, own, external, folder / "speed.png", subtitle))
    return files


def _figure(title: str, size: tuple[float, float] = _SIZE) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(size, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(title, fontsize=10)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
    return figure, axes


def _curves(
    benchmark: Benchmark, own: Sequence[Summary], external: Sequence[Summary], path: Path, subtitle: str, y_label: str
) -> Path:
    figure, axes = _figure(f"{benchmark.title}\n{subtitle}")
    by_label = {line.row: line for line in own}
    success = y_label == "success rate"
    for series in dict.fromkeys(row.series for row in benchmark.rows):
        points = [
            (row.x, by_label[row.label]) for row in benchmark.rows if row.series == series and row.label in by_label
        ]
        x = [place for place, _ in points]
        if not points:
            continue
        if success:
            rates = [line.success_rate for _, line in points]
            below = [max(line.success_rate - line.success_low, 0.0) for _, line in points]
            above = [max(line.success_high - line.success_rate, 0.0) for _, line in points]
            axes.errorbar(x, rates, yerr=[below, above], marker="o", capsize=3, label=series)
        else:
            colour = axes.plot(x, _means(points, "mean_speed"), marker="o", label=f"{series}, mean")[0].get_color()
            axes.plot(x, _means(points, "max_speed"), marker="^", linestyle=":", color=colour, label=f"{series}, max")
    for i, line in enumerate(external):
        value = line.success_rate if success else line.mean["mean_speed"]
        if value is not None:
            axes.axhline(value, color=f"C{i + 5}", linestyle="--", label=f"{line.planner}, {line.row}")
    axes.set_xlabel(benchmark.x_label)
    axes.set_ylabel(y_label)
    axes.set_ylim(-0.03, 1.03) if success else axes.set_ylim(bottom=0.0)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    return _save(figure, path)


def _means(points: Sequence[tuple[Any, Summary]], name: str) -> list[float]:
    values = (line.mean[name] for _, line in points)
    return [float("nan") if value is None else value for value in values]


def _bars(summaries: Sequence[Summary], path: Path, title: str, ours: str) -> Path:
    figure, axes = _figure(title, (_SIZE[0], max(2.5, 1.2 + 0.3 * len(summaries))))
    for place, line in enumerate(summaries):
        error = [[max(line.success_rate - line.success_low, 0.0)], [max(line.success_high - line.success_rate, 0.0)]]
        axes.barh(place, line.success_rate, xerr=error, capsize=3, color="C0" if line.planner == ours else "C1")
    axes.set_yticks(
        range(len(summaries)),
        [line.row if line.planner == ours else f"{line.row}: {line.planner}" for line in summaries],
        fontsize=8,
    )
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.03)
    axes.set_xlabel("success rate with its 95 % interval")
    return _save(figure, path)


def _speed_bars(
    benchmark: Benchmark, own: Sequence[Summary], external: Sequence[Summary], path: Path, subtitle: str
) -> Path:
    """Draw mean speeds as a group of bars per row: our planner, the published results, the external planners."""
    figure, axes = _figure(f"{benchmark.title}\n{subtitle}")
    rows = {row.label: row for row in benchmark.rows}
    bars: dict[str, dict[int, float]] = {}
    for place, line in enumerate(own):
        row = rows[line.row]
        speeds = [(line.planner, line.mean["mean_speed"])]
        speeds += [(f"{paper.planner}, published", paper.mean_speed) for paper in PUBLISHED
                   if paper.scene == row.published]  # fmt: skip
        same_worlds = [summary for summary in external if summary.row == row.world_kind]
        speeds += [(summary.planner, summary.mean["mean_speed"]) for summary in same_worlds]
        for planner, speed in speeds:
            bars.setdefault(planner, {})[place] = speed or 0.0
    width = 0.8 / max(len(bars), 1)
    for i, (planner, speeds) in enumerate(bars.items()):
        places = [place + width * (i - 0.5 * (len(bars) - 1)) for place in speeds]
        axes.bar(places, list(speeds.values()), width, label=planner)
    axes.set_xticks(range(len(own)), [line.row for line in own])
    axes.set_ylabel("mean speed of arrived flights [m/s]")
    axes.legend(fontsize=8)
    return _save(figure, path)


def _throughput(benchmark: Benchmark, own: Sequence[Summary], path: Path, subtitle: str) -> Path:
    figure, axes = _figure(f"{benchmark.title}\n{subtitle}")
    places = {row.label: row.x for row in benchmark.rows}
    lines = [line for line in own if line.flights_per_minute]
    axes.plot([places[line.row] for line in lines], [line.flights_per_minute for line in lines], marker="o")
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xlabel(benchmark.x_label)
    axes.set_ylabel("flights per minute")
    return _save(figure, path)


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path)
    return path
