"""Samples of a soak, what is judged of them, and their table, file and curve."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median

TICK_RATE = 50.0
"""Ticks of a flight per second."""
FREEZE = 30.0
"""Time without any change of a page after which it counts as frozen [s]."""
_GROWTH = {
    "memory_mb": (0.05, 20.0),
    "threads": (0.0, 3.0),
    "files": (0.0, 5.0),
    "fast_heap_mb": (0.3, 40.0),
    "fast_process_mb": (0.2, 40.0),
}
"""Growth from the second quarter of a run to the last one that is a leak: a share of the value plus a number."""


@dataclass(frozen=True)
class Sample:
    """State of the server and of both pages at one time."""

    minutes: float
    memory_mb: float
    """Resident memory of the server [MB]."""
    cpu: float
    """CPU time of the server since the last sample, per time."""
    threads: int
    files: int
    """Open file descriptors of the server."""
    ticks: int
    """Ticks since the last sample."""
    missed: float
    """Ticks since the last sample that a session on time would have made in addition."""
    flights: int
    clients: int
    fast_age: float
    """Longest time without a change on the page since the last sample [s]; likewise of the slow one."""
    slow_age: float
    fast_heap_mb: float
    """Memory of the page's JavaScript [MB]; likewise of the slow one."""
    slow_heap_mb: float
    fast_process_mb: float
    """Resident memory of the process of the fast page [MB]."""


def problems(samples: Sequence[Sample]) -> list[str]:
    """Return what must not happen in a soak, one sentence each."""
    found = []
    for page in ("fast", "slow"):
        worst = max(getattr(sample, f"{page}_age") for sample in samples)
        if worst > FREEZE:
            found.append(f"The {page} page stood still for {worst:.0f} s.")
    if any(sample.clients != 2 for sample in samples):
        found.append("A page lost its connection.")
    quarter = len(samples) // 4
    if not quarter:
        return found
    for name, (share, number) in _GROWTH.items():
        early, late = (
            median(getattr(sample, name) for sample in part)
            for part in (samples[quarter : 2 * quarter], samples[-quarter:])
        )
        if late > early * (1.0 + share) + number:
            found.append(f"{name} grew from {early:g} to {late:g} between the second and the last quarter.")
    return found


def table(samples: Sequence[Sample], rows: int = 8) -> str:
    """Return a Markdown table with `rows` equal parts of the run, one a row."""
    head = "| minutes | memory | threads | files | ticks per s | missed | flights | longest standstill: fast, slow "
    head += "| fast page: heap, process |"
    lines = [head, "| --- " * 9 + "|"]
    for k in range(min(rows, len(samples))):
        part = samples[k * len(samples) // rows : (k + 1) * len(samples) // rows] or samples[k : k + 1]
        ticks, missed = sum(s.ticks for s in part), sum(s.missed for s in part)
        last = part[-1]
        lines.append(
            f"| {part[0].minutes:.0f} to {last.minutes:.0f} | {median(s.memory_mb for s in part):.0f} MB "
            f"| {max(s.threads for s in part)} | {max(s.files for s in part)} "
            f"| {TICK_RATE * ticks / max(ticks + missed, 1.0):.1f} | {100.0 * missed / max(ticks + missed, 1.0):.1f} % "
            f"| {last.flights} | {max(s.fast_age for s in part):.1f} s, {max(s.slow_age for s in part):.1f} s "
            f"| {median(s.fast_heap_mb for s in part):.0f} MB, {median(s.fast_process_mb for s in part):.0f} MB |"
        )
    return "\n".join(lines)


def write_csv(samples: Sequence[Sample], path: Path) -> None:
    """Write all samples."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Sample)])
        writer.writeheader()
        writer.writerows({name: round(value, 3) for name, value in asdict(sample).items()} for sample in samples)


_CURVES = (
    ("memory_mb", "memory of the server [MB]", "#1f77b4"),
    ("share", "ticks on time [%]", "#2ca02c"),
    ("fast_age", "fast page: longest standstill [s]", "#ff7f0e"),
    ("slow_age", "slow page: longest standstill [s]", "#d62728"),
)
_WIDTH, _HEIGHT, _LEFT, _POINTS = 640, 70, 50, 90


def curve(samples: Sequence[Sample]) -> str:
    """Return a drawing (SVG) of memory, ticks and standstills over the run."""
    step = -(-len(samples) // _POINTS)
    parts = [samples[k : k + step] for k in range(0, len(samples), step)]
    height = _HEIGHT * len(_CURVES) + 30
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH + _LEFT + 10}" height="{height}" '
        'font-family="sans-serif" font-size="11"><rect width="100%" height="100%" fill="#fff"/>'
    ]
    last = samples[-1].minutes or 1.0
    for row, (name, title, color) in enumerate(_CURVES):
        values = [_value(part, name) for part in parts]
        top, bottom = max(*values, 1.0) * 1.05, _HEIGHT * (row + 1)
        points = " ".join(
            f"{_LEFT + _WIDTH * part[-1].minutes / last:.0f},{bottom - 50 * value / top:.0f}"
            for part, value in zip(parts, values, strict=True)
        )
        out += [
            f'<path d="M{_LEFT} {bottom - 50}V{bottom}H{_LEFT + _WIDTH}" fill="none" stroke="#999"/>',
            f'<text x="{_LEFT}" y="{bottom - 55}">{title}</text>',
            f'<text x="{_LEFT - 5}" y="{bottom - 42}" text-anchor="end">{top:.0f}</text>',
            f'<text x="{_LEFT - 5}" y="{bottom}" text-anchor="end">0</text>',
            f'<polyline points="{points}" fill="none" stroke="{color}"/>',
        ]
    out.append(f'<text x="{_LEFT + _WIDTH}" y="{height - 10}" text-anchor="end">{last:.0f} minutes</text></svg>')
    return "\n".join(out) + "\n"


def _value(part: Sequence[Sample], name: str) -> float:
    if name == "share":
        ticks, missed = sum(s.ticks for s in part), sum(s.missed for s in part)
        return 100.0 * ticks / max(ticks + missed, 1.0)
    return max(getattr(sample, name) for sample in part)
