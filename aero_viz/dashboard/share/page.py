"""The web page of a shared flight: viser's client with a recording, and figures that run along with it."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aero_viz.dashboard import palette
from aero_viz.dashboard.panels import markup
from aero_viz.dashboard.panels.title import title
from aero_viz.dashboard.share.legend import RecordedLegend
from aero_viz.dashboard.share.notice import NOTICE

COLUMNS = ("time", "speed", "clearance")
"""Columns of the figures: [s], [m/s], [m]."""
_WIDTH, _HEIGHT = 236, 34
_STYLE = f"""
<style>
#aero{{position:fixed;right:14px;top:14px;z-index:5;width:260px;padding:12px;border-radius:10px;color:#dfe5ee;
background:rgba(18,23,32,.82);font:12px/1.45 system-ui,sans-serif;font-variant-numeric:tabular-nums}}
#aero b{{font-size:14px}} #aero code{{word-break:break-word;color:#9fb0c8}}
#aero summary{{cursor:pointer;margin-top:6px}}
#aero svg{{display:block;margin:2px 0 6px}} #aero .muted{{color:{palette.css(palette.MUTED)}}}
.mantine-Select-wrapper{{width:4.6em!important}}
@media (max-width:700px){{#aero{{width:200px;transform:scale(.85);transform-origin:100% 0}}}}
</style>
"""
_SCRIPT = """
<script>
(() => {
  const rows = __ROWS__, ends = __ENDS__, start = rows[0][0], end = rows[rows.length - 1][0];
  const low = document.querySelectorAll("#aero .aero-low"), high = document.querySelectorAll("#aero .aero-high");
  const find = (name) => document.getElementById("aero-" + name);
  const show = window.aeroShow = (passed) => {
    const time = Math.min(start + passed, end);
    let row = 0, last = rows.length - 1;
    while (row < last) {
      const mid = (row + last + 1) >> 1;
      if (rows[mid][0] <= time + 0.05) row = mid; else last = mid - 1;
    }
    find("time").textContent = time.toFixed(1) + " s";
    find("speed").textContent = rows[row][1].toFixed(1) + " m/s";
    find("clearance").textContent = rows[row][2].toFixed(2) + " m";
    ends[row].forEach(([least, most], i) => { low[i].textContent = least; high[i].textContent = most; });
    find("end").style.visibility = time > end - 0.15 ? "visible" : "hidden";
    const x = __WIDTH__ * (time - start) / Math.max(end - start, 1e-9);
    for (const line of document.querySelectorAll("#aero line")) line.setAttribute("transform", `translate(${x})`);
  };
  const field = () => document.querySelector(".mantine-NumberInput-input");
  setInterval(() => { if (field()) show(parseFloat(field().value) || 0); }, 80);
})();
</script>
"""

REWOUND = "window.aeroRewound?.()"
"""Script that a recording runs before all else: a page that goes back in time takes it from the start."""
_DRAW_AGAIN = """
<script>
(() => {
  const request = window.requestAnimationFrame.bind(window), cancel = window.cancelAnimationFrame.bind(window);
  const waiting = new Map();
  let isRewound = false;
  const drawNow = (time) => {
    if (!isRewound) return;
    isRewound = false;
    for (const [id, draw] of [...waiting]) { window.cancelAnimationFrame(id); draw(time); }
  };
  window.aeroRewound = () => { isRewound = true; };
  window.requestAnimationFrame = (draw) => {
    const id = request((time) => { waiting.delete(id); draw(time); });
    waiting.set(id, draw);
    request(drawNow);
    return id;
  };
  window.cancelAnimationFrame = (id) => { waiting.delete(id); cancel(id); };
})();
</script>
"""
"""Script that draws a picture again before it is shown, where the page has just gone back in time.

viser moves nodes before it draws, but replaces lines and points only afterwards. Without the script, the first picture
after a jump would show the plan and the trail of the time before it.
"""


def page(
    client: str,
    figures: NDArray[np.float64],
    *,
    name: str,
    ending: str,
    command: str,
    legend: RecordedLegend,
) -> str:
    """Return the page of a flight.

    Args:
        client: page that plays the recording.
        figures: one row for each tick, with the columns `COLUMNS`.
        name: name of the source.
        ending: how the flight ended.
        command: command that shows the flight live.
        legend: meaning of the colours, of the same ticks as the figures.
    """
    body = client.index("<body")
    body = client.index(">", body) + 1
    head = client.index("<title>"), client.index("</title>") + len("</title>")
    rows = json.dumps(np.round(figures, 3).tolist(), separators=(",", ":"))
    ends = json.dumps(legend.ends, separators=(",", ":"))
    script = _SCRIPT.replace("__ROWS__", rows).replace("__ENDS__", ends).replace("__WIDTH__", str(_WIDTH))
    panel = _panel(figures, name=name, ending=ending, command=command, legend=legend)
    titled = f"{client[: head[0]]}{NOTICE}<title>{markup.text(title(name))}</title>{client[head[1] : body]}"
    return titled + _DRAW_AGAIN + _STYLE + panel + script + client[body:]


def _panel(figures: NDArray[np.float64], *, name: str, ending: str, command: str, legend: RecordedLegend) -> str:
    curves = "".join(
        f'<div>{label} <span id="aero-{label}"></span></div>{_curve(figures[:, 0], figures[:, i], color)}'
        for i, (label, color) in enumerate(zip(COLUMNS[1:], (palette.CHOSEN, palette.ANCHOR), strict=True), start=1)
    )
    return (
        f'<div id="aero"><b>{markup.text(name)}</b> <span id="aero-time" class="muted"></span>{curves}'
        f'<div id="aero-end">{markup.text(ending)}</div>'
        f"<details><summary>Legend</summary>{markup.legend(legend.entries)}</details>"
        f'<details><summary>About</summary><div class="muted">Space pauses; drag turns, the wheel zooms. Live, with '
        f"every parameter to change:</div><code>{markup.text(command)}</code></details></div>"
    )


def _curve(times: NDArray[np.float64], values: NDArray[np.float64], color: Any) -> str:
    """Return a small curve with a cursor."""
    span, top = max(times[-1] - times[0], 1e-9), max(values.max(), 1e-9)
    rows = slice(None, None, max(len(times) // 300, 1))
    x, y = _WIDTH * (times[rows] - times[0]) / span, _HEIGHT * (1.0 - 0.94 * values[rows] / top)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f'<svg width="{_WIDTH}" height="{_HEIGHT}"><polyline points="{points}" fill="none" stroke-width="1.5" '
        f'stroke="{palette.css(color)}"/><line y1="0" y2="{_HEIGHT}" stroke="#fff" stroke-opacity=".6"/></svg>'
    )
