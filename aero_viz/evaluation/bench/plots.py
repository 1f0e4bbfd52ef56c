"""Plots of a benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aero_viz.evaluation.bench.published_results import PUBLISHED
from aero_viz.evaluation.bench.suites import Benchmark
from aero_viz.extras import from_extra
from aero_viz.statistics import Summary

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
    with from_extra("pictures", "Plots"):
        import matplotlib
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # the current folder may have a matplotlibrc, which fails or runs LaTeX
        return _draw(benchmark, summaries, folder, subtitle, ours)


def _draw(benchmark: Benchmark, summaries: Sequence[Summary], folder: Path, subtitle: str, ours: str) -> list[Path]:
    """Do the work of `plot`."""
    own = [summary for summary in summaries if summary.planner == ours]
    external = [summary for summary in summaries if summary.planner != ours]
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
    by_label = {summary.row: summary for summary in own}
    success = y_label == "success rate"
    for series in dict.fromkeys(row.series for row in benchmark.rows):
        points = [
            (row.x, by_label[row.label]) for row in benchmark.rows if row.series == series and row.label in by_label
        ]
        if not points:
            continue
        x = [position for position, _ in points]
        if success:
            rates = [summary.success_rate for _, summary in points]
            errors = _error_bars([summary for _, summary in points])
            axes.errorbar(x, rates, yerr=errors, marker="o", capsize=3, label=series)
        else:
            color = axes.plot(x, _means(points, "mean_speed"), marker="o", label=f"{series}, mean")[0].get_color()
            axes.plot(x, _means(points, "max_speed"), marker="^", linestyle=":", color=color, label=f"{series}, max")
    for i, summary in enumerate(external):
        value = summary.success_rate if success else summary.mean["mean_speed"]
        if value is not None:
            axes.axhline(value, color=f"C{i + 5}", linestyle="--", label=f"{summary.planner}, {summary.row}")
    axes.set_xlabel(benchmark.x_label)
    axes.set_ylabel(y_label)
    axes.set_ylim(-0.03, 1.03) if success else axes.set_ylim(bottom=0.0)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)
    return _save(figure, path)


def _error_bars(summaries: Sequence[Summary]) -> list[list[float]]:
    """Return the lengths of the error bars below and above the success rates."""
    return [
        [max(summary.success_rate - summary.success_low, 0.0) for summary in summaries],
        [max(summary.success_high - summary.success_rate, 0.0) for summary in summaries],
    ]


def _means(points: Sequence[tuple[Any, Summary]], name: str) -> list[float]:
    values = (summary.mean[name] for _, summary in points)
    return [float("nan") if value is None else value for value in values]


def _bars(summaries: Sequence[Summary], path: Path, title: str, ours: str) -> Path:
    figure, axes = _figure(title, (_SIZE[0], max(2.5, 1.2 + 0.3 * len(summaries))))
    for position, summary in enumerate(summaries):
        color = "C0" if summary.planner == ours else "C1"
        axes.barh(position, summary.success_rate, xerr=_error_bars([summary]), capsize=3, color=color)
    axes.set_yticks(
        range(len(summaries)),
        [summary.row if summary.planner == ours else f"{summary.row}: {summary.planner}" for summary in summaries],
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
    for position, summary in enumerate(own):
        row = rows[summary.row]
        speeds = [(summary.planner, summary.mean["mean_speed"])]
        speeds += [(f"{paper.planner}, published", paper.mean_speed) for paper in PUBLISHED
                   if paper.scene == row.published]  # fmt: skip
        same_worlds = [result for result in external if result.row in (row.label, row.world_kind)]
        speeds += [(result.planner, result.mean["mean_speed"]) for result in same_worlds]
        for planner, speed in speeds:
            bars.setdefault(planner, {})[position] = speed or 0.0
    width = 0.8 / max(len(bars), 1)
    for i, (planner, speeds) in enumerate(bars.items()):
        positions = [position + width * (i - 0.5 * (len(bars) - 1)) for position in speeds]
        axes.bar(positions, list(speeds.values()), width, label=planner)
    axes.set_xticks(range(len(own)), [summary.row for summary in own])
    axes.set_ylabel("mean speed of arrived flights [m/s]")
    axes.legend(fontsize=8)
    return _save(figure, path)


def _throughput(benchmark: Benchmark, own: Sequence[Summary], path: Path, subtitle: str) -> Path:
    figure, axes = _figure(f"{benchmark.title}\n{subtitle}")
    x_by_row = {row.label: row.x for row in benchmark.rows}
    points = [(x_by_row[summary.row], summary.flights_per_minute) for summary in own if summary.flights_per_minute]
    axes.plot([x for x, _ in points], [rate for _, rate in points], marker="o")
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xlabel(benchmark.x_label)
    axes.set_ylabel("flights per minute")
    return _save(figure, path)


def _save(figure: Any, path: Path) -> Path:
    figure.savefig(path)
    return path
