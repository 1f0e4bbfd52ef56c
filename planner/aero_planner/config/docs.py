"""The parameters as a Markdown table, derived from the configuration's fields."""

from __future__ import annotations

from aero_planner.config import ParameterInfo, PlannerConfig, parameters

__all__ = ["format_parameters"]


def format_parameters() -> str:
    """Return all parameters in Markdown: one table per section, with the presets that differ from the default."""
    lines: list[str] = []
    section = ""
    for info in parameters():
        if info.section != section:
            section = info.section
            title = ["parameter", "symbol", "default", "paper", "range", "unit", "kind", "meaning"]
            lines += ["", f"## {section}", "", _row(title), _row(["---"] * len(title))]
        lines.append(_row(_cells(info)))
    presets = [f"- `{name}`: {help}" for name, help in PlannerConfig.presets().items()]
    return "\n".join(["# Planner parameters", "", "Presets:", "", *presets, *lines])


def _cells(info: ParameterInfo) -> list[str]:
    paper = PlannerConfig.preset("paper").get(info.path)
    bounds = ", ".join(info.choices) if info.choices else f"{info.low:g} .. {info.high:g}"
    if isinstance(info.default, bool):
        bounds = "true, false"
    return [
        f"`{info.path}`",
        info.symbol,
        _text(info.default),
        "" if paper == info.default else _text(paper),
        bounds,
        info.unit,
        "live" if info.live else "structural",
        info.help,
    ]


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
