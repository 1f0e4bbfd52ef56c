"""Small pieces of HTML for the status panel. Texts from outside go through `text`."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

from aero_viz.dashboard import palette
from aero_viz.dashboard.palette import Rgb, css

__all__ = ["bars", "block", "key", "metrics", "note", "pill", "scale", "stacked", "text"]

_FONT = "font-size:12px;line-height:1.45;font-variant-numeric:tabular-nums"


def text(value: object) -> str:
    """Return `value` as harmless HTML."""
    return html.escape(str(value))


def block(*parts: str) -> str:
    """Stack parts."""
    rows = "".join(f'<div style="margin-bottom:9px">{part}</div>' for part in parts if part)
    return f'<div style="{_FONT};padding:4px 12px 2px 12px">{rows}</div>'


def pill(label: str, color: Rgb) -> str:
    """A word on a coloured ground."""
    return (
        f'<span style="display:inline-block;padding:1px 9px;border-radius:9px;font-weight:600;margin-right:6px;'
        f'color:{css(color)};background:{css(color, 0.16)}">{text(label)}</span>'
    )


def muted(label: str) -> str:
    """A word of less importance."""
    return f'<span style="color:{css(palette.MUTED)}">{text(label)}</span>'


def note(label: str) -> str:
    """A small line of its own under a control; nothing for nothing."""
    return f'<div style="{_FONT};font-size:11px;padding:0 12px">{muted(label)}</div>' if label else ""


def metrics(values: Iterable[tuple[str, str, str]]) -> str:
    """Figures in two columns: label, number, unit."""
    cells = "".join(
        f'<div><div style="color:{css(palette.MUTED)};font-size:11px">{text(label)}</div>'
        f'<span style="font-size:16px;font-weight:600">{text(number)}</span> {muted(unit)}</div>'
        for label, number, unit in values
    )
    return f'<div style="display:grid;grid-template-columns:1fr 1fr 1fr;gap:4px 8px">{cells}</div>'


def heading(label: str, value: str = "") -> str:
    """A label on the left and a figure on the right."""
    return f'<div style="display:flex;justify-content:space-between">{muted(label)}<span>{text(value)}</span></div>'


def stacked(parts: Sequence[tuple[str, float, Rgb]], unit: str) -> str:
    """One bar, divided in proportion, with a legend below; parts below 2 % have no entry there."""
    total = max(sum(value for _, value, _ in parts), 1e-9)
    bar = "".join(
        f'<div style="width:{100 * value / total:.2f}%;background:{css(color)}"></div>' for _, value, color in parts
    )
    legend = " ".join(
        f'<span style="white-space:nowrap;margin-right:7px">{dot(color)}{muted(label)} {value:.1f}</span>'
        for label, value, color in parts
        if value > 0.02 * total
    )
    return (
        f'<div title="{text(unit)}" style="display:flex;height:9px;border-radius:3px;overflow:hidden;margin:3px 0">'
        f"{bar}</div>"
        f'<div style="font-size:11px">{legend}</div>'
    )


def bars(values: Sequence[tuple[float, str, Rgb, bool]]) -> str:
    """Columns side by side: height in [0, 1], tooltip, colour, whether marked."""
    columns = "".join(
        f'<div title="{text(tip)}" style="flex:1;height:{max(4.0, 100.0 * height):.0f}%;background:{css(color)};'
        f'border-radius:2px 2px 0 0{";outline:1px solid #fff" if marked else ""}"></div>'
        for height, tip, color, marked in values
    )
    return f'<div style="display:flex;align-items:flex-end;gap:2px;height:42px;margin-top:4px">{columns}</div>'


def dot(color: Rgb) -> str:
    """A small disc."""
    return (
        f'<span style="display:inline-block;width:8px;height:8px;border-radius:4px;margin-right:5px;'
        f'background:{css(color)}"></span>'
    )


def key(entries: Iterable[tuple[str, Rgb]]) -> str:
    """What each colour means, in two columns."""
    items = "".join(f"<div>{dot(color)}{muted(label)}</div>" for label, color in entries)
    return f'<div style="display:grid;grid-template-columns:1fr 1fr;gap:1px 8px;font-size:11px">{items}</div>'


def scale(label: str, low: str, high: str, table: palette.Table) -> str:
    """A colormap with its ends."""
    return (
        f'<div style="font-size:11px">{muted(label)}<div style="height:7px;border-radius:3px;margin:2px 0;'
        f'background:{palette.gradient(table)}"></div><div style="display:flex;justify-content:space-between">'
        f"<span>{text(low)}</span><span>{text(high)}</span></div></div>"
    )
