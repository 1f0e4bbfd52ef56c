"""The report of a benchmark: flights.csv, worlds.csv, summary.csv, summary.json, PNG plots and report.md."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from aero_viz.errors import UserError
from aero_viz.evaluation.bench.causes import cause_rows
from aero_viz.evaluation.bench.difficulty_groups import DIFFICULTY, GROUPS_NOTE, format_groups, mean_std
from aero_viz.evaluation.bench.external_results import ExternalResults
from aero_viz.evaluation.bench.plots import plot
from aero_viz.evaluation.bench.published_results import PUBLISHED
from aero_viz.evaluation.bench.runner import STAGE_FIELD, Run
from aero_viz.evaluation.bench.success_matrix import IMPOSSIBLE_NOTE, format_matrix
from aero_viz.evaluation.bench.suites import Benchmark
from aero_viz.statistics import METRICS, Summary, summarise
from aero_viz.text_table import format_table

OURS = "AERO-Viz"
"""Name of our planner in the summaries."""
_CAUSES = ["cause of failure", "flights", "row and seed of the world, for example"]
_STAGES_NOTE = (
    "Measured while all drones fly, 2 s after the start. Planner, vehicle, LiDAR and sweeps add up to the tick. The "
    "stages of the planner run one after another here."
)


def summarise_run(run: Run, external: Sequence[ExternalResults] = ()) -> list[Summary]:
    """Return a summary of each row that has flights, then of the external flights."""
    summaries = []
    for row in run.benchmark.rows:
        flights = [flight for flight in run.flights if flight["row"] == row.label]
        if flights:
            summaries.append(summarise(flights, row=row.label, planner=OURS))
    for results in external:
        summaries.append(summarise(results.flights, row=results.label, planner=results.planner))
    return summaries


def write_report(run: Run, folder: str | Path, *, external: Sequence[ExternalResults] = ()) -> list[Summary]:
    """Write all files of a report into `folder` and return the summaries in it.

    Raises:
        UserError: a file cannot be written.
    """
    folder = Path(folder)
    summaries = summarise_run(run, external)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write_csv(folder / "flights.csv", run.flights, last=("cause", "obstacle"))
        _write_csv(folder / "worlds.csv", world_records(run))
        _write_csv(folder / "summary.csv", [_flat(summary) for summary in summaries])
        content = {**run.header, "complete": run.is_complete, "summary": [summary.to_dict() for summary in summaries]}
        (folder / "summary.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        plots = _plots(run, summaries, folder)
        (folder / "report.md").write_text(_markdown(run, summaries, plots), encoding="utf-8")
    except OSError as error:
        raise UserError(f"Cannot write the report to {folder}: {error.strerror or error}.") from error
    return summaries


def _plots(run: Run, summaries: Sequence[Summary], folder: Path) -> list[str]:
    """Draw the plots and return a line of Markdown for each, or one that says why there are none."""
    if not summaries:
        return []
    try:
        files = plot(run.benchmark, summaries, folder, subtitle=_subtitle(run), ours=OURS)
    except UserError as error:
        return [str(error)]
    return [f"![{path.stem}]({path.name})" for path in files]


def format_summaries(summaries: Sequence[Summary]) -> str:
    """Return the summaries as a table for a terminal."""
    rows = [
        [summary.row, summary.planner, f"{summary.arrived}/{summary.flights}", _interval(summary),
         _percent(summary.passable), _mean_std(summary, "mean_speed"), _reasons(summary)]
        for summary in summaries
    ]  # fmt: skip
    header = ["row", "planner", "success", "95 % interval", "passable", "mean speed", "ended by"]
    return format_table(rows, header=header)


def format_causes(run: Run) -> str:
    """Return the causes of all failures as a table for a terminal; empty without failures."""
    rows = _cause_cells(run)
    return format_table(rows, header=_CAUSES) if rows else ""


def _cause_cells(run: Run) -> list[list[str]]:
    return [[cause, str(count), examples] for cause, count, examples in cause_rows(run.flights)]


def world_records(run: Run) -> list[dict[str, Any]]:
    """Return a record per world: kind, seed, whether a path exists, difficulty. The easiest of a kind come first."""
    kinds = {row.label: row.world_kind for row in run.benchmark.rows}
    order = list(dict.fromkeys(kinds.values()))
    found = {
        (kinds[flight["row"]], flight["world_seed"]): {name: flight.get(name) for name in ("passable", *DIFFICULTY)}
        for flight in run.flights
    }
    if run.benchmark.worlds:  # a file is the same world whatever the seed
        found = {(kind, run.header["seed"]): about for (kind, _), about in found.items()}
    records = [{"kind": kind, "seed": seed, **about} for (kind, seed), about in found.items()]

    def rank(record: dict[str, Any]) -> tuple[int, float, int]:
        difficulty = math.inf if record["difficulty"] is None else record["difficulty"]
        return 0 if run.benchmark.worlds else order.index(record["kind"]), difficulty, record["seed"]

    return sorted(records, key=rank)


def format_worlds(run: Run) -> list[str]:
    """Return a line per kind of world: in how many a path exists for the drone's radius, and their difficulty."""
    kinds: dict[str, list[dict[str, Any]]] = {}
    for record in world_records(run):
        kinds.setdefault(record["kind"], []).append(record)
    return [_format_kind(kind, records, is_file=bool(run.benchmark.worlds)) for kind, records in kinds.items()]


def _format_kind(kind: str, records: Sequence[dict[str, Any]], *, is_file: bool) -> str:
    known = [record for record in records if record["difficulty"] is not None]
    values = [[record[name] for record in known] for name in DIFFICULTY[:3]] if known else []
    names = ("traversability obstruction", "view occlusion", "angle over length")
    difficulty = ", ".join(f"{name} {mean_std(each)}" for name, each in zip(names, values, strict=False))
    suffix = f"; {difficulty}" if difficulty else ""
    if records[0]["passable"] is None:
        return f"{kind}: not examined" if is_file else f"{kind}: {len(records)} worlds, not examined"
    if is_file:
        return f"{kind}: {'a path exists' if records[0]['passable'] else 'no path within the field'}{suffix}"
    seeds = [record["seed"] for record in records]
    closed = [str(record["seed"]) for record in records if not record["passable"]]
    line = (
        f"{kind}, seeds {min(seeds)} to {max(seeds)}: a path exists in {len(records) - len(closed)} of {len(records)} "
        "worlds"
    )
    return (f"{line}, none with the seeds {', '.join(sorted(closed, key=int))}" if closed else line) + suffix


def _markdown(run: Run, summaries: Sequence[Summary], plots: Sequence[str]) -> str:
    benchmark, header = run.benchmark, run.header
    own = {summary.row: summary for summary in summaries if summary.planner == OURS}
    parts = [f"# {benchmark.title}", benchmark.note]
    if not run.is_complete:
        parts.append(f"**Incomplete: {len(run.flights)} of {run.total} flights.** Resume the run to fly the rest.")
    if matrix := format_matrix(run):
        parts += ["## Success in per cent", _markdown_table(matrix[0], matrix[1:])]
        parts += [IMPOSSIBLE_NOTE] if any(row.sudden for row in benchmark.rows) else []
        parts.append("## Success of each row")
    parts.append(_success_table(summaries))
    parts += plots
    parts += ["## Arrived flights", _metrics_table(benchmark, summaries)]
    if any(row.published for row in benchmark.rows):
        parts.append(
            "Published: Chen et al., AERO-MPPI, arXiv 2509.17340, 50 successful flights per row, simulated in MARSIM. "
            "The other planners flew with lower velocity limits where they failed. The paper shows success rates as "
            "plots: above 80 % for AERO-MPPI at 7 m/s in all three scenes. It does not say how smoothness was "
            "discretised. Ours is the sum over the ticks of the squared change of the mean acceleration, divided by "
            "the duration of a tick, and it is much larger."
        )
    if causes := _cause_cells(run):
        parts += ["## Causes of failures", _markdown_table(_CAUSES, causes)]
    targets = _targets_table(benchmark, own)
    if targets:
        parts += ["## Targets", targets]
    groups = format_groups(run)
    if groups:
        parts += ["## Success over difficulty", GROUPS_NOTE, _markdown_table(groups[0], groups[1:])]
    if benchmark.metric == "throughput":
        parts += ["## Throughput", "Of one batch each.", _throughput_table(run, own)]
        parts += ["## Stages of a tick [ms]", _STAGES_NOTE, _stages_table(run)]
    radius = header["simulation"]["rules"]["radius"]
    parts += [f"## Paths for a radius of {radius:g} m", "\n".join(f"- {line}" for line in format_worlds(run))]
    parts += ["## Conditions", _conditions(run), "### Configuration", _config(header)]
    return "\n\n".join(parts) + "\n"


def _success_table(summaries: Sequence[Summary]) -> str:
    rows = [
        [summary.row, summary.planner, f"{summary.arrived}/{summary.flights}", _percent(summary.success_rate),
         _interval(summary), _percent(summary.passable), _reasons(summary)]
        for summary in summaries
    ]  # fmt: skip
    header = ["row", "planner", "arrived", "success", "95 % interval", "worlds with a path", "ended by"]
    return _markdown_table(header, rows)


def _metrics_table(benchmark: Benchmark, summaries: Sequence[Summary]) -> str:
    header = ["row", "planner", "mean speed [m/s]", "max speed [m/s]", "smoothness [m²/s⁵]", "length [m]",
              "mean clearance [m]", "min clearance [m]", "time [s]", "plan of a batch [ms]"]  # fmt: skip
    published = {row.label: row.published for row in benchmark.rows}
    rows = []
    for summary in summaries:
        values = [_mean_std(summary, name) for name in METRICS]
        rows.append([summary.row, summary.planner, *values, _plan_time(summary)])
        for paper in PUBLISHED:
            if summary.planner == OURS and paper.scene == published.get(summary.row):
                rows.append(
                    [summary.row, f"{paper.planner}, published", *(_number(value) for value in paper[2:]), "", ""]
                )
    return _markdown_table(header, rows)


def _targets_table(benchmark: Benchmark, own: dict[str, Summary]) -> str:
    rows = []
    for row in benchmark.rows:
        summary = own.get(row.label)
        if row.target is None or summary is None:
            continue
        rate, speed = row.target
        reached = summary.mean["mean_speed"]
        met = summary.success_rate >= rate and (speed is None or (reached is not None and reached >= speed))
        target = _percent(rate) + ("" if speed is None else f" at {speed:g} m/s")
        at = "" if reached is None else f" at {_mean_std(summary, 'mean_speed')} m/s"
        share = f"{_percent(summary.success_rate)} ({_interval(summary)})"
        rows.append([row.label, target, f"{share}{at}", "yes" if met else "no"])
    return _markdown_table(["row", "target", "reached", "met"], rows) if rows else ""


def _throughput_table(run: Run, own: dict[str, Summary]) -> str:
    rows = []
    for row in run.benchmark.rows:
        flights = [flight for flight in run.flights if flight["row"] == row.label]
        if not flights:
            continue
        summary, first = own[row.label], flights[0]
        rows.append([row.label, _number(summary.flights_per_minute, 1), _number(first["run_s"], 1),
                     _number(first["build_s"], 1), _plan_time(summary)])  # fmt: skip
    return _markdown_table(["row", "flights per minute", "flying [s]", "building [s]", "plan of a batch [ms]"], rows)


def _stages_table(run: Run) -> str:
    """Return the times of the stages, a row per stage and a column per batch."""
    batches = {flight["row"]: flight for flight in run.flights}
    names = dict.fromkeys(name for flight in batches.values() for name in flight if name.startswith(STAGE_FIELD))
    rows = [
        [name.removeprefix(STAGE_FIELD), *(_number(flight.get(name), 3) for flight in batches.values())]
        for name in names
    ]
    return _markdown_table(["stage", *batches], rows)


def _conditions(run: Run) -> str:
    header = run.header
    first_world = header["seed"] + run.benchmark.first_seed
    batches = {flight["batch"]: flight for flight in run.flights}
    seconds = sum(batch["run_s"] + batch["build_s"] for batch in batches.values())
    rows = [
        ["date", header["date"]],
        *([name.replace("_", " "), str(value)] for name, value in header["hardware"].items()),
        *([f"version of {name}", value] for name, value in header["versions"].items()),
        ["flights per row", str(header["flights"])],
        ["seeds of the worlds", f"from {first_world}"],
        ["LiDAR", header["lidar"] or ", ".join(dict.fromkeys(row.lidar for row in run.benchmark.rows))],
        ["configuration", header["config_name"]],
        ["flights in a batch", f"at most {header['batch']}"],
        ["wall time", f"{seconds:.0f} s in {len(batches)} batches"],
    ]
    names = {"lidar": "changes of the LiDAR", "drone": "changes of the drone", "noise": "noise of the state estimate"}
    for name, changes in header["simulation"].items():
        text = ", ".join(f"{key} {value:g}" for key, value in (changes or {}).items())
        rows += [[names.get(name, name), text]] if text else []
    limits = ", ".join(f"{speed:g}" for speed in dict.fromkeys(row.speed for row in run.benchmark.rows))
    rows.append(["velocity limit", f"{limits} m/s"])
    return _markdown_table(["what", "value"], rows) + (
        "\n\nA flight fails when the centre of the drone comes closer to a surface than its radius, when the drone "
        "makes no progress, or when it leaves the world or exceeds the time limit. In a world with a path, a ball of "
        "that radius can move from start to goal at about their height and within the field, the rectangle around "
        "start, goal and obstacles; drones may also fly around it. Means are over the flights that arrived, ± one "
        "standard deviation. The time of a plan is the median over the batches (and their range)."
    )


def _config(header: dict[str, Any]) -> str:
    from aero_planner.config.file import format_config
    from aero_viz.planners.registry import config_of_entry

    lines = format_config(config_of_entry(header)).splitlines()
    kept = [line for line in lines if line and not line.lstrip().startswith("#")]
    return "\n".join(["```yaml", *kept, "```"])


def _subtitle(run: Run) -> str:
    header = run.header
    lidar = header["lidar"] or " and ".join(dict.fromkeys(row.lidar for row in run.benchmark.rows))
    noun = "worlds" if any(row.batch for row in run.benchmark.rows) else "flights"
    return f"configuration {header['config_name']}, LiDAR {lidar}, {header['flights']} {noun} per row"


def _flat(summary: Summary) -> dict[str, Any]:
    values = summary.to_dict()
    for kind in ("mean", "std"):
        values |= {f"{name}_{kind}": value for name, value in values.pop(kind).items()}
    values["reasons"] = _reasons(summary)
    values["plan_ms_min"], values["plan_ms_max"] = values.pop("plan_ms_range") or (None, None)
    return values


def _write_csv(path: Path, rows: Sequence[dict[str, Any]], *, last: Sequence[str] = ()) -> None:
    """Write a table whose last columns are there also where no row has them."""
    with path.open("w", newline="", encoding="utf-8") as file:
        if rows:
            columns = [key for row in rows for key in row if key not in last]
            writer = csv.DictWriter(file, [*dict.fromkeys(columns), *last])
            writer.writeheader()
            writer.writerows(rows)


def _markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _interval(summary: Summary) -> str:
    return f"{100 * summary.success_low:.0f} to {100 * summary.success_high:.0f} %"


def _reasons(summary: Summary) -> str:
    return ", ".join(f"{count} {reason}" for reason, count in summary.reasons.items())


def _mean_std(summary: Summary, name: str) -> str:
    mean, std = summary.mean[name], summary.std[name]
    return _number(mean) if std is None else f"{_number(mean)} ± {_number(std)}"


def _plan_time(summary: Summary) -> str:
    limits = summary.plan_ms_range
    return _number(summary.plan_ms_median) + (f" ({limits[0]:.2f} to {limits[1]:.2f})" if limits else "")


def _percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f} %"


def _number(value: float | None, digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}"
