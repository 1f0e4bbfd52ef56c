"""HTML snippets for the panels. Strings from outside this program must go through `text`."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence

from aero_viz.dashboard import palette
from aero_viz.dashboard.layers import Bar, ColorKey, ColorScale
from aero_viz.dashboard.palette import Rgb, css

_FONT = "font-size:12px;line-height:1.45;font-variant-numeric:tabular-nums"


def text(value: object) -> str:
    """Return `value` with HTML characters escaped."""
    return html.escape(str(value))


def ink(color: Rgb) -> str:
    """Return a colour for text as CSS: darker on light panels, lighter on dark ones."""
    return f"color-mix(in srgb,{css(color)} 60%,currentColor)"


def block(*parts: str) -> str:
    """Return the parts stacked vertically; empty ones are left out."""
    rows = "".join(f'<div style="margin-bottom:9px">{part}</div>' for part in parts if part)
    return f'<div style="{_FONT};padding:4px 12px 2px 12px">{rows}</div>'


def pill(label: str, color: Rgb) -> str:
    """Return a short text on a coloured background."""
    return (
        f'<span style="display:inline-block;padding:1px 9px;border-radius:9px;font-weight:600;margin-right:6px;'
        f'color:{ink(color)};background:{css(color, 0.16)}">{text(label)}</span>'
    )


def muted(label: str) -> str:
    """Return a text in a muted colour."""
    return f'<span style="color:{css(palette.MUTED)}">{text(label)}</span>'


def note(label: str) -> str:
    """Return a small line of text below a control; empty for an empty label."""
    return f'<div style="{_FONT};font-size:11px;padding:0 12px">{muted(label)}</div>' if label else ""


def metrics(values: Iterable[tuple[str, str, str]]) -> str:
    """Return a grid of figures, each given as label, number and unit."""
    cells = "".join(
        f'<div><div style="color:{css(palette.MUTED)};font-size:11px">{text(label)}</div>'
        f'<span style="font-size:16px;font-weight:600">{text(number)}</span> {muted(unit)}</div>'
        for label, number, unit in values
    )
    return f'<div style="display:grid;grid-template-columns:1fr 1fr 1fr;gap:4px 8px">{cells}</div>'


def heading(label: str, value: str = "") -> str:
    """Return a label on the left with a figure on the right, or below the label where both are too long for a line."""
    style = "display:flex;flex-wrap:wrap;justify-content:space-between;column-gap:8px"
    return f'<div style="{style}">{muted(label)}<span>{text(value)}</span></div>'


def stacked(parts: Sequence[tuple[str, float, Rgb]], unit: str) -> str:
    """Return a bar divided in proportion, with a legend below that leaves out parts under 2 %."""
    total = max(sum(value for _, value, _ in parts), 1e-9)
    bar = "".join(
        f'<div style="width:{100 * value / total:.2f}%;background:{css(color)}"></div>' for _, value, color in parts
    )
    legend = " ".join(
        f'<span style="white-space:nowrap;margin-right:7px">{_dot(color)}{muted(label)} {value:.1f}</span>'
        for label, value, color in parts
        if value > 0.02 * total
    )
    return (
        f'<div title="{text(unit)}" style="display:flex;height:9px;border-radius:3px;overflow:hidden;margin:3px 0">'
        f"{bar}</div>"
        f'<div style="font-size:11px">{legend}</div>'
    )


def bars(values: Sequence[Bar]) -> str:
    """Return a chart with a column for each value."""
    columns = "".join(
        f'<div class="aero-scene" title="{text(bar.tooltip)}" style="flex:1;height:{max(4.0, 100.0 * bar.height):.0f}%;'
        f"background:{css(bar.color)};border-radius:2px 2px 0 0"
        f'{";outline:1px solid currentColor" if bar.is_marked else ""}{";opacity:0.45" if bar.is_faint else ""}"></div>'
        for bar in values
    )
    return f'<div style="display:flex;align-items:flex-end;gap:2px;height:42px;margin-top:4px">{columns}</div>'


def table(rows: Iterable[tuple[str, str, str]]) -> str:
    """Return a table with a row for each label, value and tooltip."""
    cells = "".join(
        f'<div title="{text(tooltip)}">{muted(label)}</div><div style="text-align:right">{text(value)}</div>'
        for label, value, tooltip in rows
    )
    return f'<div style="display:grid;grid-template-columns:1fr auto;gap:3px 8px">{cells}</div>'


def columns(header: Sequence[str], rows: Iterable[Sequence[str]], tooltips: Sequence[str] = ()) -> str:
    """Return a table with a header; the first column names the row, the others hold values. One tooltip per row."""
    style = f"display:grid;grid-template-columns:1fr repeat({len(header) - 1},auto);gap:2px 10px"
    cells = f"<div>{muted(header[0])}</div>" + "".join(f'<b style="text-align:right">{text(n)}</b>' for n in header[1:])
    for i, (label, *values) in enumerate(rows):
        cells += f'<div title="{text(tooltips[i] if tooltips else "")}">{muted(label)}</div>'
        cells += "".join(f'<div style="text-align:right">{text(value)}</div>' for value in values)
    return f'<div style="{style}">{cells}</div>'


def _dot(color: Rgb, *, of_scene: bool = False) -> str:
    """Return a small disc in a colour, of the panels or of the scene."""
    style = f"display:inline-block;width:8px;height:8px;border-radius:4px;margin-right:5px;background:{css(color)}"
    return f'<span class="{"aero-scene" if of_scene else ""}" style="{style}"></span>'


def key(entries: Iterable[tuple[str, Rgb]]) -> str:
    """Return a legend of single colours in two columns."""
    items = "".join(f"<div>{_dot(color, of_scene=True)}{muted(label)}</div>" for label, color in entries)
    return f'<div style="display:grid;grid-template-columns:1fr 1fr;gap:1px 8px;font-size:11px">{items}</div>'


def scale(label: str, low: str, high: str, colormap: palette.Colormap) -> str:
    """Return a legend of a colormap, with a text at either end."""
    return (
        f'<div style="font-size:11px">{muted(label)}<div class="aero-scene" style="height:7px;border-radius:3px;'
        f'margin:2px 0;background:{palette.gradient(colormap)}"></div>'
        f'<div style="display:flex;justify-content:space-between">'
        f'<span class="aero-low">{text(low)}</span><span class="aero-high">{text(high)}</span></div></div>'
    )


def legend(entries: Iterable[ColorKey | ColorScale]) -> str:
    """Return the legend of layers: colormaps first, then single colours."""
    entries = list(entries)
    scales = [scale(e.label, e.low, e.high, e.colormap) for e in entries if isinstance(e, ColorScale)]
    return block(*scales, key([(entry.label, entry.color) for entry in entries if isinstance(entry, ColorKey)]))
