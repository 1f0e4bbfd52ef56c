"""Documentation of the parameters as Markdown tables."""

from __future__ import annotations

from aero_planner.config import DroneConfig, ParameterInfo, PlannerConfig


def format_parameters(kind: type[DroneConfig] = PlannerConfig) -> str:
    """Return all parameters of a planner in Markdown, one table per section, and the list of presets."""
    paper = kind.preset("paper") if "paper" in kind.presets() else kind()
    lines: list[str] = []
    columns = ["parameter", "name", "symbol", "default", "paper", "range", "unit", "kind", "meaning"]
    for name, section in kind.sections().items():
        lines += ["", f"## {name}", "", _row(columns), _row(["---"] * len(columns))]
        lines += [_row(_cells(info, paper)) for info in section.parameters()]
    presets = [f"- `{name}`: {help}" for name, help in kind.presets().items()]
    return "\n".join(["# Planner parameters", "", "Presets:", "", *presets, *lines])


def _cells(info: ParameterInfo, preset: DroneConfig) -> list[str]:
    paper = preset.get(info.path)
    return [
        f"`{info.path}`",
        info.label,
        info.symbol,
        _text(info.default),
        "" if paper == info.default else _text(paper),
        f"{info.low:g} .. {info.high:g}" if info.is_number else info.range,
        info.unit,
        "live" if info.live else "structural",
        info.help,
    ]


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value) or "(empty)"


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
