"""The page of a map that grows or a robot that moves on it, which keeps itself up to date by server-sent events."""

from .drawing import document

_STYLE = """
:root{--good:#e7f5e9;--bad:#fde4e1}@media (prefers-color-scheme:dark){:root{--good:#17301b;--bad:#451c19}}
.faint{font-size:.9rem}section{overflow-x:auto;overflow-wrap:anywhere}svg{max-height:80vh}
.trail{fill:none;stroke:var(--start);stroke-width:2;vector-effect:non-scaling-stroke}
.robot{fill:var(--start);stroke:#fff;stroke-width:1;vector-effect:non-scaling-stroke}.lost{fill-opacity:.35;stroke:var(--start)}
.sigma{fill:var(--anchor);fill-opacity:.15;stroke:var(--anchor);vector-effect:non-scaling-stroke}
.sigma.own{fill:var(--start);stroke:var(--start)}
ol{margin:0;padding-left:1.3rem}li{margin:.2rem 0}ol li:first-child{font-weight:600}.advice{background:var(--warn)}
.fine{background:var(--good)}.late{background:var(--bad)}
@media (min-width:60rem){main{grid-template-columns:2fr 1fr}.picture{grid-column:1;grid-row:1/span 9}}
table{font-size:.85rem;overflow-wrap:normal;font-variant-numeric:tabular-nums}td,th{white-space:nowrap;vertical-align:top}
td small{display:block;color:var(--faint)}
"""

_SCRIPT = r"""
const at = id => document.getElementById(id);
let map = null, now = null, shown = null;
function arrow(pose, r, name) {
  return shape("path", {class: name, d: `M${r} 0L${-.7 * r} ${.7 * r}L${-.3 * r} 0L${-.7 * r} ${-.7 * r}Z`,
    transform: `translate(${pose[0]} ${-pose[1]}) rotate(${-pose[2] * 180 / Math.PI})`});
}
function ellipse(a, name = "") {
  const [[xx, xy], [, yy]] = a.covariance, half = (xx + yy) / 2, off = Math.hypot((xx - yy) / 2, xy);
  const axis = v => Math.min(2 * Math.sqrt(Math.max(v, 0)), 3), turn = Math.atan2(2 * xy, xx - yy) / 2 * 180 / Math.PI;
  return shape("ellipse", {class: "sigma " + name, rx: axis(half + off), ry: axis(half - off),
    transform: `translate(${a.place[0]} ${-a.place[1]}) rotate(${-turn})`});
}
function show() {
  const svg = at("map"), placed = map.anchors.filter(a => a.place);
  const points = map.paths.flat().concat(now && now.pose ? [...(now.trail || []), now.pose] : []);
  for (const a of placed) {
    const reach = k => a.sigma ? Math.min(2 * a.sigma[k], 3) : 0;
    points.push([a.place[0] - reach(0), a.place[1] - reach(1)], [a.place[0] + reach(0), a.place[1] + reach(1)]);
  }
  shown = drawMap(svg, points, placed, map.image, "/grid.png?" + map.version, 1);
  svg.append(...drawn(map.paths));
  for (const a of placed) svg.append(...(a.covariance ? [ellipse(a)] : []), anchorMark(a.id, a.place, a.side, shown.size));
  svg.append(shown.bar, shape("g", {id: "robot"}));
  at("legend").replaceChildren(...(map.paths.length ? [key("path", "path")] : []), key("start", "robot", "arrow"),
    ...(placed.length ? [key("anchor", "anchor, 2σ", "anchors")] : []));
  at("facts").textContent = map.accepted + " of " + map.candidates + " loop closures accepted";
  at("notes").replaceChildren(...map.doubts.map(t => el("li", {}, "Doubt: " + t)), ...map.warnings.map(t => el("li", {}, t)));
  at("notes").parentNode.hidden = !map.doubts.length && !map.warnings.length;
  drawRobot();
  anchors();
}
function drawRobot() {
  const layer = at("robot");
  if (layer) layer.replaceChildren();
  if (!layer || !now || !now.pose) return;
  const [x, y] = now.pose, r = shown.size / 45;
  if (x < shown.x0 || x > shown.x1 || y < shown.y0 || y > shown.y1) return show();
  layer.replaceChildren(shape("polyline", {class: "trail", points: line(now.trail || [])}),
    ...(now.alternatives || []).map(p => arrow(p, r, "robot lost")), arrow(now.pose, r, now.lost ? "robot lost" : "robot"));
  if (now.covariance) layer.prepend(ellipse({place: now.pose, covariance: now.covariance}, "own"));
}
function rows(names, lines) {
  return [el("tr", {}, ...names.map(n => el("th", {}, n))), ...lines.map(([late, ...cells]) => el("tr", late
    ? {class: "late"} : {}, ...cells.map(c => el("td", {}, c))))];
}
function anchors() {
  const rates = now && now.anchors || {}, known = map ? map.anchors : [];
  const names = [...new Set([...known.map(a => a.id), ...Object.keys(rates)])].sort();
  const measured = Object.keys(rates).length;
  at("anchors").replaceChildren(...rows(["anchor", "x ± σ, m", "y ± σ, m", ...(measured ? ["ranges/s"] : [])], names.map(id => {
    const a = known.find(a => a.id === id), s = a && a.sigma ? a.sigma.map(v => " ± " + v.toFixed(2)) : ["", ""];
    const place = a && a.place ? a.place.map((v, k) => v.toFixed(2) + s[k]) : ["", ""];
    const name = el("span", {}, id, ...(a && a.status !== "ok" ? [el("small", {}, a.status)] : []));
    return [false, name, ...place, ...(measured ? [id in rates ? rates[id] : ""] : [])];
  })));
  at("anchors").parentNode.hidden = !names.length;
}
function status() {
  at("summary").textContent = [now.summary, now.rounds].filter(Boolean).join(" · ");
  const box = at("advice"), list = now.advice || [];
  box.className = now.late ? "late" : list.length ? "advice" : "fine";
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
source.addEventListener("map", e => { map = JSON.parse(e.data); show(); });
source.onopen = () => { at("lost").hidden = true; };
source.onerror = () => { at("lost").hidden = false; };
"""


def live_page(title: str) -> str:
    """Return the page."""
    header = (
        '<div id="summary" class="faint" role="status">loading ...</div>'
        '<div id="lost" class="late" hidden>No connection; the page tries again by itself.</div>'
    )
    main = (
        '<section id="advice" aria-live="polite"></section><section class="picture">'
        '<svg id="map" role="img" aria-label="map"></svg><div id="legend" class="row faint"></div>'
        '<div id="facts" class="faint">There is no map yet.</div></section>'
        '<section hidden><h2>Sensors</h2><table id="sensors"></table></section>'
        '<section hidden><h2>Anchors</h2><table id="anchors"></table></section>'
        '<section hidden><h2>Of the latest map</h2><ul id="notes"></ul></section>'
    )
    return document(title, _STYLE, header, main, _SCRIPT)
