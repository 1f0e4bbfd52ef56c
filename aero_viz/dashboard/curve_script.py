"""Style sheet and script of the dock with the curves, below the scene."""

from __future__ import annotations

from aero_viz.dashboard import palette
from aero_viz.dashboard.palette import css
from aero_viz.dashboard.viser_private import CHARTS

_PHONE = "(max-width:36em)"
_DOCK = ".mantine-Paper-root:has(.aero-curves)"
_FRAME = f"{_DOCK}>div:has(.aero-curves)"
"""The part of a floating panel with its tabs; the other parts are handles that resize it."""
_AT = "left:calc((var(--t) - var(--lo))/(var(--hi) - var(--lo))*100%)"
_WIDE = (
    # The scene ends above the dock, so that the drone is in its middle.
    "div:has(>div>div>div>canvas[data-engine]){bottom:var(--aero-dock)!important}",
    f"{_DOCK}{{position:fixed!important;left:0!important;top:auto!important;bottom:0!important;z-index:9!important;"
    "width:var(--aero-scene)!important;max-width:none!important;height:var(--aero-dock)!important;"
    "border-radius:0!important;border-top:1px solid var(--mantine-color-default-border)}",
    f"{_DOCK}>div:not(:has(.aero-curves)),{_FRAME}>div>div>div:not(:has(.aero-curves)){{display:none!important}}",
    f"{_DOCK} :is(.mantine-ScrollArea-root,.mantine-ScrollArea-viewport,div:has(>*>.mantine-ScrollArea-root))"
    "{height:var(--aero-dock)!important;max-height:var(--aero-dock)!important}",
    f"{_DOCK} .mantine-ScrollArea-content{{display:block!important;min-width:0!important}}",
    f"{_DOCK} .mantine-ScrollArea-content div:has(>div>.aero-curves){{padding-top:0!important}}",
    f":root[data-aero-curves=closed] {_DOCK} :is(.uplot-container,.aero-lanes,.aero-ruler,.aero-fork,.aero-open)"
    "{display:none!important}",
    "div:has(>.aero-curves){position:sticky;top:0;z-index:3}div:has(>.aero-ruler){position:sticky;bottom:0;z-index:2}",
)
STYLE = "".join(
    (
        ":root{--aero-dock:2rem;--aero-scene:100vw;--aero-left:9.5rem}"
        ":root[data-aero-curves=open]{--aero-dock:clamp(11rem,33vh,19rem)}",
        f"@media not all and {_PHONE}{{{''.join(_WIDE)}}}",
        # The bar with the buttons.
        ".aero-curves{display:flex;flex-wrap:wrap;gap:.2rem .5rem;align-items:center;min-height:2rem;"
        "padding:0 .6rem;font-size:12px;background:var(--mantine-color-body)}"
        ".aero-curves .aero-space{flex:1;min-width:0;overflow:hidden;text-overflow:ellipsis;white-space:nowrap}"
        ".aero-curves :is(button,summary){font:inherit;color:inherit;background:none;border:0;border-radius:4px;"
        "padding:.25rem .5rem;cursor:pointer;list-style:none}"
        ".aero-curves :is(button,summary):is(:hover,:focus-visible){background:var(--mantine-color-default-hover)}"
        ".aero-curves .aero-toggle{font-weight:600}"
        ":root[data-aero-curves=open] .aero-toggle i,.aero-curves details[open] summary i{rotate:180deg}"
        ".aero-curves i{display:inline-block;font-style:normal;margin-right:.35rem}"
        ".aero-choice{position:fixed;z-index:20;bottom:calc(var(--aero-dock) + .3rem);width:min(36rem,100vw - 1rem);"
        "right:calc(100vw - var(--aero-scene) + .5rem);max-height:calc(100vh - var(--aero-dock) - 1rem);overflow:auto;"
        "padding:.6rem .8rem;border-radius:6px;"
        "background:var(--mantine-color-body);border:1px solid var(--mantine-color-default-border);"
        "box-shadow:0 4px 20px rgba(0,0,0,.35)}"
        ".aero-choice>div{columns:10rem}"
        ".aero-choice fieldset{border:0;padding:0;margin:0 0 .5rem;break-inside:avoid}"
        f".aero-choice legend{{color:{css(palette.MUTED)};padding:0}}"
        ".aero-choice label{display:flex;gap:.4rem;align-items:center;min-height:1.5rem;cursor:pointer}",
        # Lanes of events: a mark at each time, and its words as far as the next mark.
        ".aero-lanes{margin:0 24px 0 calc(var(--aero-left) + 52px);overflow:hidden;font-size:11px}"
        ".aero-lane{position:relative;height:1.15rem;overflow:hidden}"
        ".aero-lane button{position:absolute;top:1px;bottom:1px;display:flex;align-items:center;gap:3px;border:0;"
        f"padding:0;background:none;color:inherit;font:inherit;cursor:pointer;white-space:nowrap;{_AT};"
        "max-width:calc((var(--n) - var(--t))/(var(--hi) - var(--lo))*100%)}"
        ".aero-lane button::before{content:'';flex:none;width:3px;height:100%;border-radius:1px;background:var(--c)}"
        ".aero-lane button.aero-span{background:color-mix(in srgb,var(--c) 35%,transparent);"
        "width:calc((var(--n) - var(--t))/(var(--hi) - var(--lo))*100%)}"
        ".aero-lane button span{overflow:hidden;text-overflow:ellipsis}",
        # Lanes of curves: names and values on the left, uPlot on the right.
        f"{_DOCK} .uplot-container{{border:0!important;margin:0 0 0 var(--aero-left)!important;padding:0!important;"
        "background:none!important}",
        f"{_DOCK} div:has(>.uplot-container){{border-top:1px solid var(--mantine-color-default-border)}}",
        f"{_DOCK} .uplot-container>button{{display:none}}",
        f"{_DOCK} .u-legend{{position:absolute;left:calc(.6rem - var(--aero-left));top:3px;margin:0!important;"
        "width:calc(var(--aero-left) - .4rem);font-size:11px;text-align:left;line-height:1.2}",
        f"{_DOCK} .u-legend tbody{{display:block}}",
        f"{_DOCK} .u-legend .u-series:first-child{{display:block;color:{css(palette.MUTED)}}}",
        f"{_DOCK} .u-legend .u-series:first-child .u-value{{display:none}}",
        f"{_DOCK} .u-legend .u-series:first-child .u-marker{{display:none}}",
        f"{_DOCK} .u-legend .u-series[hidden]{{display:none!important}}",
        f"{_DOCK} .u-legend .u-series{{display:flex;justify-content:space-between;margin:0}}",
        f"{_DOCK} .u-legend :is(th,td){{padding:0!important;font-weight:400;white-space:nowrap;overflow:hidden}}",
        f"{_DOCK} .u-legend th::after{{display:none!important}}",
        f"{_DOCK} .u-legend .u-value{{font-variant-numeric:tabular-nums;width:auto!important}}",
        f"{_DOCK} .u-legend .u-off{{opacity:.35}}",
        f"{_DOCK} .u-select{{background:{css(palette.BRAND, 0.22)}}}",
        # The present tick, and where two flights first differ, in all lanes.
        f"{_DOCK} .u-over{{cursor:crosshair;overflow:hidden}}",
        f"{_DOCK} :is(.u-over,.aero-lanes)::after{{content:'';position:absolute;top:0;bottom:0;width:1px;"
        f"--t:var(--now);{_AT};background:currentColor;opacity:.8;pointer-events:none}}",
        f"{_DOCK} .u-under::after{{content:'';position:absolute;top:0;bottom:0;--t:var(--differs);{_AT};"
        f"border-left:1.5px dashed {css(palette.GHOST)}}}",
        ".aero-lanes{position:relative}",
        f".aero-ruler{{height:1.2rem;font-size:10px;color:{css(palette.MUTED)};"
        "background:var(--mantine-color-body);padding:0 24px 0 calc(var(--aero-left) + 52px)}"
        ".aero-ruler>div{position:relative;height:100%}"
        f".aero-ruler span{{position:absolute;{_AT};translate:-50%;padding:0 3px;white-space:nowrap}}"
        ".aero-ruler .aero-at{background:var(--mantine-color-default-hover);color:var(--mantine-color-text);"
        "border-radius:3px}",
        # On a phone the dock is a section of the sheet.
        f"@media {_PHONE}{{:root{{--aero-left:0rem}}.aero-only-wide{{display:none!important}}"
        f"{_DOCK} .uplot-container{{padding-top:1.5rem!important}}{_DOCK} .u-legend{{width:calc(100% - 1.2rem)}}"
        f"{_DOCK} .u-legend tbody{{display:flex!important;gap:1rem;overflow:hidden}}"
        f"{_DOCK} .u-legend .u-series{{gap:.3rem}}.aero-choice{{bottom:40vh;right:.5rem;max-height:55vh}}"
        ".aero-curves :is(button,summary,label){min-height:40px;align-content:center}}",
    )
)

SCRIPT = """
window.aeroCurves?.();
(() => {
  const KEY = "aero-curves", root = document.documentElement;
  const over = new AbortController(), options = {signal: over.signal}, known = new WeakSet();
  const phone = matchMedia("(max-width: 36em)");
  const kept = {open: false, signals: null, ...JSON.parse(localStorage.getItem(KEY) ?? "{}")};
  let span = null, told = "", due = 0, lo = 0, hi = 1, now = 0, first = 0, last = 1, shown = "", seen = null, at = null;
  let isChoosing = false;
  const find = () => document.querySelector(".aero-curves")?.closest(".mantine-Paper-root");
  const on = (target, name, act, more) => target.addEventListener(name, act, {...options, ...more});
  const keep = () => localStorage.setItem(KEY, JSON.stringify(kept));
  const text = x => x == null || Number.isNaN(x) ? "–"
    : x && (Math.abs(x) >= 1e5 || Math.abs(x) < 1e-3) ? x.toExponential(2) : `${+x.toPrecision(4)}`;
  const zoom = (low, high) => {
    const tiny = 1e-3 * (last - first);
    span = high - low < tiny || (low <= first + tiny && high >= last - tiny) ? null
      : [Math.max(low, first), Math.min(high, last)];
  };
  const charts = dock => CHARTS.filter(chart => dock.contains(chart.root));
  const prepare = chart => {
    known.add(chart);
    (chart.hooks.setSelect ??= []).push(u => {
      const {left, width} = u.select;
      if (width > 3) zoom(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
      u.setSelect({left: 0, top: 0, width: 0, height: 0}, false);
    });
    (chart.hooks.setLegend ??= []).push(u => {
      const values = u.root.querySelectorAll(".u-legend .u-value"), row = u.legend.idx;
      const hasGhost = u.series.at(-1).dash, count = (values.length - 1) / (hasGhost ? 2 : 1);
      const value = i => text(row == null ? null : u.data[i][row]);
      for (let i = 1; i < values.length; i++) {
        values[i].parentElement.hidden = i > count;
        values[i].textContent = value(i) + (hasGhost && i <= count ? ` (${value(i + count)})` : "");
      }
    });
    (chart.hooks.setCursor ??= []).push(u => {
      at = u.cursor.left >= 0 ? u.posToVal(u.cursor.left, "x") : null;
    });
    let pressed = 0;
    on(chart.over, "pointerdown", event => { pressed = event.clientX; });
    on(chart.over, "click", event => {
      if (event.detail > 1 || Math.abs(event.clientX - pressed) > 3) return;
      const {left, width} = chart.over.getBoundingClientRect();
      aeroSend({type: "AeroSeekMessage", time: lo + (hi - lo) * (event.clientX - left) / width});
    });
    on(chart.over, "dblclick", () => { span = null; });
    on(chart.over, "wheel", event => {
      if (!event.ctrlKey && !event.shiftKey) return;  // the wheel alone scrolls the lanes
      event.preventDefault();
      const {left, width} = chart.over.getBoundingClientRect();
      const factor = Math.exp(2e-3 * (event.deltaY || event.deltaX));
      const center = lo + (hi - lo) * (event.clientX - left) / width;
      zoom(center - (center - lo) * factor, center + (hi - center) * factor);
    }, {passive: false});
  };
  const look = () => {
    const scene = document.querySelector("canvas[data-engine]")?.parentElement;
    if (!scene || scene === seen) return;
    seen = scene;
    const width = () => root.style.setProperty("--aero-scene", `${scene.getBoundingClientRect().width}px`);
    const observer = new ResizeObserver(width);
    observer.observe(scene);
    over.signal.addEventListener("abort", () => observer.disconnect());
  };
  const clear = () => {  // panels that float end above the dock
    for (const paper of document.querySelectorAll('.mantine-Paper-root[style*="position: absolute"]')) {
      if (paper.querySelector(".aero-curves")) continue;
      const {top, bottom} = paper.getBoundingClientRect(), moved = parseFloat(paper.style.translate.split(" ")[1] ?? 0);
      const room = find()?.getBoundingClientRect().top ?? innerHeight;
      const up = phone.matches ? 0 : Math.max(0, Math.min(bottom - moved - (room - 10), top - moved - 5));
      paper.style.translate = `0 ${-up}px`;
    }
  };
  const ruler = (dock, chart) => {
    const times = chart?.axes[0]._splits ?? [], names = chart?.axes[0]._values ?? [];
    const mark = at ?? now, line = dock.querySelector(".aero-ruler>div");
    const rows = times.map((t, i) => `<span style="--t:${t}">${names[i]}</span>`);
    rows.push(`<span class="aero-at" style="--t:${Math.min(Math.max(mark, lo), hi)}">${mark.toFixed(2)} s</span>`);
    const content = rows.join("");
    if (line && line.aeroShown !== content) line.innerHTML = line.aeroShown = content;
  };
  const draw = () => {
    if (over.signal.aborted) return;
    requestAnimationFrame(draw);
    look();
    const dock = find(), state = dock?.querySelector("#aero-curve-state");
    if (!state) return;
    const isOpen = phone.matches ? state.checkVisibility() : kept.open;
    root.dataset.aeroCurves = kept.open ? "open" : "closed";
    [first, last, now] = ["first", "last", "now"].map(name => Number(state.dataset[name]));
    if (span && (span[1] <= first || span[0] >= last)) span = null;  // another flight
    [lo, hi] = span ?? [first, Math.max(last, first + 1e-3)];
    const lanes = charts(dock);
    const width = Math.round(lanes[0]?.over.clientWidth ?? innerWidth);
    const message = {type: "AeroCurvesMessage", is_open: isOpen, signals: kept.signals, span, width};
    const view = JSON.stringify(message);
    if (view !== shown) due = performance.now() + (shown ? 150 : 0);
    shown = view;
    if (view !== told && performance.now() >= due) {
      told = view;
      aeroSend(message);
    }
    dock.querySelector(".aero-whole").hidden = !span;
    dock.querySelector(".aero-toggle").ariaExpanded = kept.open;
    const choice = dock.querySelector(".aero-choice");
    if (!choice.aeroIsSet) {  // the page makes the bar anew whenever a lane comes or goes
      const boxes = kept.signals ? choice.querySelectorAll("input") : [];
      for (const box of boxes) box.checked = kept.signals.includes(box.value);
      choice.parentElement.open = isChoosing;
      choice.aeroIsSet = true;
    }
    if (!isOpen) return;
    for (const [name, value] of Object.entries({lo, hi, now, differs: state.dataset.differs || first - 1e6})) {
      if (dock.style.getPropertyValue(`--${name}`) !== `${value}`) dock.style.setProperty(`--${name}`, value);
    }
    for (const chart of lanes) {
      if (!known.has(chart)) prepare(chart);
      const {min, max} = chart.scales.x;
      if ((min !== lo || max !== hi) && !chart.select.width) chart.setScale("x", {min: lo, max: hi});
      if (chart.cursor.left < 0) {
        const row = chart.valToIdx(now);
        if (chart.legend.idx !== row || chart.aeroData !== chart.data) chart.setLegend({idx: row}, true);
        chart.aeroData = chart.data;
      }
    }
    ruler(dock, lanes[0]);
  };
  const picture = () => {
    const dock = find(), lanes = charts(dock), scale = devicePixelRatio, left = 160;
    if (!lanes.length) return;
    const paper = document.createElement("canvas");
    const size = lanes.map(chart => [chart.root.querySelector("canvas"), chart.height + 8]);
    paper.width = (left + lanes[0].width) * scale;
    paper.height = (size.reduce((sum, [, height]) => sum + height, 0) + 30) * scale;
    const pen = paper.getContext("2d"), style = getComputedStyle(dock);
    pen.scale(scale, scale);
    pen.fillStyle = style.backgroundColor;
    pen.fillRect(0, 0, paper.width, paper.height);
    pen.font = "11px sans-serif";
    let top = 8;
    lanes.forEach((chart, i) => {
      chart.root.querySelectorAll(".u-legend .u-series").forEach((series, row) => {
        pen.fillStyle = row ? series.querySelector(".u-marker").style.borderColor || style.color : style.color;
        const value = row ? `  ${series.querySelector(".u-value").textContent}` : "";
        pen.fillText(series.querySelector(".u-label").textContent + value, 8, top + 10 + 13 * row);
      });
      pen.drawImage(size[i][0], left, top, chart.width, chart.height);
      top += size[i][1];
    });
    pen.fillStyle = style.color;
    const chart = lanes[0], start = left + chart.over.offsetLeft;
    chart.axes[0]._splits.forEach((t, i) => {
      pen.fillText(chart.axes[0]._values[i], start + chart.valToPos(t, "x") - 8, top + 10);
    });
    pen.fillText(`t [s], values at ${now.toFixed(2)} s`, 8, top + 10);
    const link = document.createElement("a");
    link.download = "curves.png";
    link.href = paper.toDataURL("image/png");
    link.click();
  };
  on(document, "click", ({target}) => {
    const button = target.closest?.("[data-aero]"), open = document.querySelector(".aero-curves details[open]");
    if (open && !open.contains(target)) open.open = false;
    if (!button) return;
    const actions = {
      toggle: () => { kept.open = !kept.open; keep(); },
      whole: () => { span = null; },
      csv: () => aeroSend({type: "AeroCurvesSaveMessage"}),
      png: picture,
      seek: () => aeroSend({type: "AeroSeekMessage", time: Number(button.dataset.time)}),
    };
    actions[button.dataset.aero]?.();
  });
  on(document, "toggle", ({target}) => {
    if (target.matches(".aero-curves details")) isChoosing = target.open;
  }, {capture: true});
  on(document, "change", ({target}) => {
    if (!target.closest?.(".aero-choice")) return;
    kept.signals = [...target.closest(".aero-choice").querySelectorAll("input:checked")].map(box => box.value);
    keep();
  });
  const timer = setInterval(clear, 300);
  window.aeroCurves = () => { over.abort(); clearInterval(timer); };
  draw();
})();
""".replace("CHARTS", CHARTS)
"""Script of the dock. It keeps the times that are looked at, which all lanes share, tells the server what is looked at,
and turns clicks into requests. What is open, and which signals are chosen, it stores in the browser."""
