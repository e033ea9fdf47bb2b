"""Diagrams to play with in a page: hover for method, step and costs, click on a name to switch its curve off or on.

Plain SVG that a few lines of script in the page draw from the numbers; nothing is fetched, no library is needed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from kcons.comparison.study.tables import duration
from kcons.comparison.work_precision.chosen_curves import chosen
from kcons.comparison.work_precision.fronts import COSTS, points
from kcons.comparison.work_precision.measurement import Comparison, Measurement
from kcons.comparison.work_precision.report import style

STYLE = """
.diagram { position: relative; margin: 1rem 0; color: #222; background: #fff; padding: 0.5rem; }
.diagram svg { width: min(100%, 34rem); height: auto; vertical-align: top; }
.diagram .off { display: none; }
.diagram button { font: inherit; font-size: 0.75rem; margin: 0.1rem; border: 1px solid #8886; border-radius: 0.3rem;
  background: none; color: #222; cursor: pointer; }
.diagram button.out { opacity: 0.35; }
.diagram button::before { content: "●"; color: var(--c); margin-right: 0.3rem; }
.diagram .tip { position: absolute; display: none; background: #fff; border: 1px solid #888; padding: 0.2rem 0.5rem;
  font-size: 0.8rem; white-space: pre; pointer-events: none; z-index: 2; }
"""

SCRIPT = """
const W = 520, H = 400, L = 66, R = 12, T = 12, B = 46;
const node = (name, attributes, parent, text) => {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  parent.append(made);
  return made;
};
const log = Math.log10;
function panel(box, data, column, tip) {
  const svg = node("svg", {viewBox: `0 0 ${W} ${H}`, role: "img"}, box);
  const all = data.curves.flatMap(c => c.p).filter(p => p[column] > 0);
  if (!all.length) return {};
  const span = k => {
    const values = all.map(p => log(p[k])), low = Math.min(...values), high = Math.max(...values);
    return [low - 0.15, Math.max(high, low + 0.5) + 0.15];
  };
  const [x0, x1] = span(column), [y0, y1] = span(2);
  const X = v => L + (log(v) - x0) / (x1 - x0) * (W - L - R), Y = v => H - B - (log(v) - y0) / (y1 - y0) * (H - B - T);
  const ticks = (low, high) => {
    const found = [], few = high - low < 2.5 ? [1, 2, 5] : [1];
    for (let e = Math.floor(low); e <= high; e++)
      for (const s of few) if (log(s) + e >= low && log(s) + e <= high) found.push(s * 10 ** e);
    return found;
  };
  const shown = v => v >= 1e4 || v < 0.01 ? v.toExponential(0) : String(+v.toPrecision(2));
  for (const v of ticks(x0, x1)) {
    node("line", {x1: X(v), x2: X(v), y1: T, y2: H - B, stroke: "#ddd"}, svg);
    node("text", {x: X(v), y: H - B + 16, "font-size": 11, "text-anchor": "middle"}, svg, shown(v));
  }
  for (const v of ticks(y0, y1)) {
    node("line", {x1: L, x2: W - R, y1: Y(v), y2: Y(v), stroke: "#ddd"}, svg);
    node("text", {x: L - 6, y: Y(v) + 4, "font-size": 11, "text-anchor": "end"}, svg, shown(v));
  }
  node("rect", {x: L, y: T, width: W - L - R, height: H - B - T, fill: "none", stroke: "#888"}, svg);
  const below = {x: (L + W) / 2, y: H - 8, "font-size": 12, "text-anchor": "middle"};
  node("text", below, svg, data.axes[column]);
  const left = {transform: `translate(14 ${H / 2}) rotate(-90)`, "font-size": 12, "text-anchor": "middle"};
  node("text", left, svg, data.axes[2]);
  return Object.fromEntries(data.curves.map(c => {
    const g = node("g", {}, svg), p = c.p.filter(q => q[column] > 0);
    const line = p.map(q => `${X(q[column])},${Y(q[2])}`).join(" ");
    node("polyline", {points: line, fill: "none", stroke: c.c, "stroke-width": 1.5}, g);
    for (const q of p) {
      const place = {cx: X(q[column]), cy: Y(q[2]), r: 4.5, fill: c.c, "fill-opacity": 0.35, stroke: c.c};
      const dot = node("circle", place, g);
      dot.onmousemove = event => {
        const at = box.getBoundingClientRect();
        tip.textContent = `${c.t}\\n${q[3]}\\nerror ${q[4]}\\n${q[5]} force evaluations\\nwall time ${q[6]}`;
        tip.style.display = "block";
        tip.style.left = Math.min(event.clientX - at.left + 14, at.width - 190) + "px";
        tip.style.top = event.clientY - at.top + 14 + "px";
      };
      dot.onmouseleave = () => { tip.style.display = "none"; };
    }
    return [c.t, g];
  }));
}
for (const box of document.querySelectorAll(".diagram")) {
  const data = JSON.parse(box.querySelector("script").textContent);
  const tip = document.createElement("div");
  tip.className = "tip";
  const both = [0, 1].map(column => panel(box, data, column, tip));
  const names = document.createElement("div");
  for (const c of data.curves) {
    const button = document.createElement("button");
    button.textContent = c.t;
    button.style.setProperty("--c", c.c);
    const set = on => {
      button.classList.toggle("out", !on);
      for (const groups of both) groups[c.t]?.classList.toggle("off", !on);
    };
    set(c.on);
    button.onclick = () => set(button.classList.contains("out"));
    names.append(button);
  }
  box.append(names, tip);
}
"""


def head() -> str:
    """What the head of a page needs."""
    return f'<style>{STYLE}</style><script type="module">{SCRIPT}</script>'


def diagram(comparison: Comparison) -> str:
    """HTML of one diagram; '' where no method has an error.

    All methods are there; those that `chosen_curves` leaves out are switched off at first.
    """
    units = comparison.scene["units"]
    first = {title for curve in chosen(comparison) for title in (curve.label, *curve.alike)}
    curves: dict[str, dict[str, Any]] = {}
    for m in points(comparison, "evaluations"):
        if not m.error:
            continue
        entry = curves.setdefault(m.method, {"t": m.title, "c": style(m.method)[0], "on": m.title in first, "p": []})
        step = f"rtol {m.setting:.0e}" if m.adaptive else f"step {m.setting:.4g} {units['time']}"
        error = f"{float(m.error):.2e} {comparison.error_unit}"
        spent = "" if m.seconds_per_time is None else duration(m.seconds_per_time)
        entry["p"].append([m.evaluations_per_time, m.seconds_per_time, m.error, step, error, _number(m), spent])
    if not curves:
        return ""
    (_, evaluations), (_, wall) = COSTS["evaluations"], COSTS["wall"]
    long = units["long_time"]
    axes = [f"{evaluations} a simulated {long}", f"{wall} a simulated {long} / s", f"error / {comparison.error_unit}"]
    data = json.dumps({"axes": axes, "curves": list(curves.values())}, ensure_ascii=False).replace("<", "\\u003c")
    return f'<div class="diagram"><script type="application/json">{data}</script></div>'


def diagrams(comparisons: Mapping[str, Comparison]) -> dict[str, str]:
    """HTML of each comparison that has errors to show."""
    return {name: html for name, found in comparisons.items() if (html := diagram(found))}


def _number(m: Measurement) -> str:
    value = m.evaluations_per_time or 0.0
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
