"""The page of a map that grows or a robot that moves on it: HTML, styles and script, without a framework or a network.

The script builds everything with text nodes, so that no name out of a recording becomes markup. It keeps itself up to date
by server-sent events and connects again by itself.
"""

import html

from ..report.page import coloured
from . import drawing

_STYLE = """
:root{--paper:#f6f7f9;--card:#fff;--ink:#1f2733;--faint:#6b7482;--line:#d8dde4;--path:@path@;--anchor:@anchor@;
--robot:@start@;--warn:#fff4e0;--good:#e7f5e9;--bad:#fde4e1}
@media (prefers-color-scheme:dark){:root{--paper:#14181e;--card:#1d232b;--ink:#e4e8ee;--faint:#98a2b0;--line:#36404c;
--path:@path-dark@;--anchor:@anchor-dark@;--robot:@start-dark@;--warn:#3a2f1a;--good:#17301b;--bad:#451c19}}
*{box-sizing:border-box}body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.45 system-ui,sans-serif}
header{position:sticky;top:0;z-index:2;padding:.5rem 1rem;background:var(--card);border-bottom:1px solid var(--line)}
h1{font-size:1.05rem;margin:0}h2{font-size:1rem;margin:0 0 .3rem}.faint{font-size:.9rem}
main{display:grid;gap:.8rem;padding:.8rem;grid-template-columns:repeat(auto-fit,minmax(min(100%,24rem),1fr))}
section{overflow-x:auto;background:var(--card);border:1px solid var(--line);border-radius:.5rem;padding:.7rem;min-width:0;
overflow-wrap:anywhere}svg{max-height:80vh}
.path,.trail{fill:none;stroke:var(--path);stroke-width:2;vector-effect:non-scaling-stroke}.trail{stroke:var(--robot)}
.p1{stroke:@path1@}.p2{stroke:@path2@}.p3{stroke:@path3@}.robot{fill:var(--robot);stroke:#fff;stroke-width:1;
vector-effect:non-scaling-stroke}.lost{fill-opacity:.35}.sigma{fill:var(--anchor);fill-opacity:.15;
stroke:var(--anchor);vector-effect:non-scaling-stroke}
ol{margin:0;padding-left:1.3rem}li{margin:.2rem 0}li:first-child{font-weight:600}.advice{background:var(--warn)}
.fine{background:var(--good)}.late{background:var(--bad)}
@media (min-width:60rem){main{grid-template-columns:2fr 1fr}.picture{grid-column:1;grid-row:1/span 9}}
table{border-collapse:collapse;width:100%;
font-size:.85rem;overflow-wrap:normal;font-variant-numeric:tabular-nums}
td,th{text-align:left;padding:.15rem .5rem .15rem 0;font-weight:400;white-space:nowrap}
th{color:var(--faint)}
"""

_SCRIPT = r"""
const at = id => document.getElementById(id);
let map = null, now = null, shown = null;
const line = points => points.map(p => p[0] + "," + -p[1]).join(" ");
function arrow(pose, r, name) {
  return shape("path", {class: name, d: `M${r} 0L${-.7 * r} ${.7 * r}L${-.3 * r} 0L${-.7 * r} ${-.7 * r}Z`,
    transform: `translate(${pose[0]} ${-pose[1]}) rotate(${-pose[2] * 180 / Math.PI})`});
}
function ellipse(a) {
  const [[xx, xy], [, yy]] = a.covariance, half = (xx + yy) / 2, off = Math.hypot((xx - yy) / 2, xy);
  const axis = v => Math.min(2 * Math.sqrt(Math.max(v, 0)), 3), turn = Math.atan2(2 * xy, xx - yy) / 2 * 180 / Math.PI;
  return shape("ellipse", {class: "sigma", rx: axis(half + off), ry: axis(half - off),
    transform: `translate(${a.place[0]} ${-a.place[1]}) rotate(${-turn})`});
}
function drawMap() {
  const svg = at("map"), placed = map.anchors.filter(a => a.place);
  const points = map.paths.flat().concat(now && now.pose ? [...(now.trail || []), now.pose] : []);
  for (const a of placed) {
    const reach = k => a.sigma ? Math.min(2 * a.sigma[k], 3) : 0;
    points.push([a.place[0] - reach(0), a.place[1] - reach(1)], [a.place[0] + reach(0), a.place[1] + reach(1)]);
  }
  if (map.image) points.push([map.image.x, map.image.y], [map.image.x + map.image.width, map.image.y + map.image.height]);
  if (!points.length) points.push([0, 0]);
  const xs = points.map(p => p[0]), ys = points.map(p => p[1]);
  makeRoom(xs, ys, placed);
  const x0 = Math.min(...xs) - 1, x1 = Math.max(...xs) + 1, y0 = Math.min(...ys) - 1, y1 = Math.max(...ys) + 1;
  shown = [x0, y0, x1, y1];
  const size = Math.max(x1 - x0, y1 - y0);
  svg.setAttribute("viewBox", [x0, -y1, x1 - x0, y1 - y0].join(" "));
  svg.dataset.size = size;
  const layer = shape("g", {});
  if (map.image) layer.append(shape("image", {href: "/grid.png?" + map.version, x: map.image.x,
    y: -map.image.y - map.image.height, width: map.image.width, height: map.image.height, preserveAspectRatio: "none"}));
  map.paths.forEach((path, k) => layer.append(shape("polyline", {class: "path p" + k % 4, points: line(path)})));
  for (const a of placed) {
    if (a.covariance) layer.append(ellipse(a));
    layer.append(anchorMark(a.id, a.place, size));
  }
  layer.append(scaleBar(x0 + size / 40, -y0 - size / 40, size));
  svg.replaceChildren(layer, shape("g", {id: "robot"}));
  at("legend").replaceChildren(key("path", "path"), key("robot", "robot", "disc"),
    ...(placed.length ? [key("anchor", "anchor, 2σ", "anchors")] : []));
  at("facts").textContent = map.accepted + " of " + map.candidates + " loop closures accepted";
  at("notes").replaceChildren(...map.doubts.map(t => el("li", {}, "Doubt: " + t)), ...map.warnings.map(t => el("li", {}, t)));
  at("notes").parentNode.hidden = !map.doubts.length && !map.warnings.length;
  drawRobot();
  anchors();
}
function drawRobot() {
  const layer = at("robot"), size = Number(at("map").dataset.size);
  if (layer) layer.replaceChildren();
  if (!layer || !now || !now.pose) return;
  const [x, y] = now.pose, r = size / 45, [x0, y0, x1, y1] = shown;
  if (x < x0 || x > x1 || y < y0 || y > y1) return drawMap();
  layer.replaceChildren(shape("polyline", {class: "trail", points: line(now.trail || [])}),
    ...(now.alternatives || []).map(p => arrow(p, r, "robot lost")), arrow(now.pose, r, now.lost ? "robot lost" : "robot"));
  if (now.covariance) layer.prepend(ellipse({place: now.pose, covariance: now.covariance}));
}
function rows(names, lines) {
  return [el("tr", {}, ...names.map(n => el("th", {}, n))), ...lines.map(([late, ...cells]) => el("tr", late
    ? {class: "late"} : {}, ...cells.map(c => el("td", {}, String(c)))))];
}
function anchors() {
  const rates = now && now.anchors || {}, known = map ? map.anchors : [];
  const names = [...new Set([...known.map(a => a.id), ...Object.keys(rates)])].sort();
  at("anchors").replaceChildren(...rows(["anchor", "x ± σ, m", "y ± σ, m", "ranges/s", ""], names.map(id => {
    const a = known.find(a => a.id === id), s = a && a.sigma ? a.sigma.map(v => " ± " + v.toFixed(2)) : ["", ""];
    const place = a && a.place ? a.place.map((v, k) => v.toFixed(2) + s[k]) : ["", ""];
    return [false, id, ...place, id in rates ? rates[id] : "", a && a.status !== "ok" ? a.status : ""];
  })));
  at("anchors").parentNode.hidden = !names.length;
}
function status() {
  at("summary").textContent = [now.summary, now.rounds].filter(Boolean).join(" · ");
  const box = at("advice"), list = now.advice || [];
  box.className = list.length ? "advice" : "fine";
  box.replaceChildren(list.length ? el("ol", {}, ...list.map(t => el("li", {}, t)))
    : el("div", {}, now.fine || "Nothing to do: go on driving."));
  const sensors = now.sensors || [];
  const silent = sensors.some(s => s.late);
  at("sensors").replaceChildren(...rows(["sensor", "messages", "per second", ...(silent ? ["silent"] : [])], sensors.map(s =>
    [s.late, s.name, s.count, s.rate, ...(silent ? [s.late ? s.silent + " s" : ""] : [])])));
  at("sensors").parentNode.hidden = !sensors.length;
  drawRobot();
  anchors();
}
const source = new EventSource("/events");
source.addEventListener("status", e => { now = JSON.parse(e.data); status(); });
source.addEventListener("map", e => { map = JSON.parse(e.data); drawMap(); });
source.onopen = () => { at("lost").hidden = true; };
source.onerror = () => { at("lost").hidden = false; };
"""


def live_page(title: str) -> str:
    """Return the page."""
    name = html.escape(title)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{name}</title><link rel=icon href=data:,><style>{coloured(drawing.STYLE + _STYLE)}</style></head><body>"
        f'<header><h1>{name}</h1><div id="summary" class="faint" role="status">loading ...</div>'
        '<div id="lost" class="late" hidden>No connection; the page tries again by itself.</div></header><main>'
        '<section id="advice" aria-live="polite"></section><section class="picture">'
        '<svg id="map" role="img" aria-label="map"></svg><div id="legend" class="row faint"></div>'
        '<div id="facts" class="faint">There is no map yet.</div></section>'
        '<section hidden><h2>Sensors</h2><table id="sensors"></table></section>'
        '<section hidden><h2>Anchors</h2><table id="anchors"></table></section>'
        '<section hidden><h2>Of the latest map</h2><ul id="notes"></ul></section>'
        f"</main><script>{drawing.SCRIPT}{_SCRIPT}</script></body></html>"
    )
