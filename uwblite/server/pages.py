"""The pages of `uwblite view` and of what happens now: markup, styles, and scripts that put names in as text alone.

The map comes as markup, from which svg_map has taken what a name could mean in it.
"""

from html import escape

from ..report.page import SCALED, document, key

_STYLE = """
body{background:var(--paper)}
header{position:sticky;top:0;z-index:2;padding:.5rem 1rem;background:var(--card);border-bottom:1px solid var(--line)}
h1{font-size:1.1rem;margin:0}h2{font-size:1rem;margin:0 0 .3rem}
main{display:grid;gap:.8rem;padding:.8rem;grid-template-columns:repeat(auto-fit,minmax(min(100%,25rem),1fr))}
section{background:var(--card);border:1px solid var(--line);border-radius:.5rem;padding:.8rem;min-width:0}
table{width:100%}td,th{padding:.15rem .5rem .15rem 0;font-weight:400}th,.faint{color:var(--faint)}
.row{display:flex;flex-wrap:wrap;gap:.5rem;align-items:center;margin-top:.3rem}
"""

_SCRIPT = """
function el(name, attrs = {}, ...children) {
  const node = document.createElement(name);
  for (const [k, v] of Object.entries(attrs)) {
    if (k.startsWith("on")) node.addEventListener(k.slice(2), v); else node.setAttribute(k, v);
  }
  node.append(...children);
  return node;
}
function drawnMap(box, markup) {
  box.innerHTML = markup;
  const svg = box.firstChild;
  if (svg) scaled(svg);
  return svg;
}
"""

_VIEW_STYLE = """
:root{--accent:#2563eb}@media (prefers-color-scheme:dark){:root{--accent:#7aa5ff}button.main{color:#10151c}}
header{display:flex;flex-wrap:wrap;gap:.6rem 1rem;align-items:center}#say{color:var(--faint);flex:1 1 12rem}
.map{max-height:62vh}.closure *,.anchor{cursor:pointer}
.closure .hit,.closure .hit:hover{stroke:transparent;stroke-width:calc(var(--s)*12px)}
.closure .force{stroke:var(--start);stroke-width:calc(var(--s)*3px);stroke-dasharray:none;opacity:1}
.closure .reject{stroke:var(--ink);stroke-width:calc(var(--s)*3px);stroke-dasharray:calc(var(--s)*4px);opacity:1}
.closure .chosen{stroke-width:calc(var(--s)*6px);opacity:1}
.start,.end{pointer-events:none}.anchor.pinned path{fill:var(--start)}
button,input{font:inherit;border:1px solid var(--line);border-radius:.4rem;background:var(--card);color:inherit}
button{padding:.35rem .8rem;cursor:pointer;min-height:2.4rem}input{width:6rem;padding:.25rem}
button.main{background:var(--accent);border-color:var(--accent);color:#fff}button:disabled{opacity:.5;cursor:default}
.detail{min-height:5.2rem;padding:.5rem 0;border-top:1px solid var(--line);margin-top:.6rem}
.doubt{background:var(--warn);border-radius:.3rem;padding:.4rem .6rem;margin:.4rem 0}a{color:var(--accent)}
.list{max-height:16rem;overflow:auto;border-top:1px solid var(--line);margin-top:.5rem}
.list button{min-height:0;padding:.1rem .5rem}
"""

_VIEW_SCRIPT = r"""
const say = document.getElementById("say"), main = document.querySelector("main");
let state = null, chosen = null, timer = 0;
const key = (name, text, form = "") =>
  el("span", {}, el("i", {class: "key " + form, style: `color:var(--${name})`}), " " + text);
const meters = values => values.map(v => v.toFixed(2));
async function ask(path, wish) {
  const options = wish ? {method: "POST", body: JSON.stringify(wish),
    headers: {"Content-Type": "application/json", "X-Token": main.dataset.token}} : {};
  try {
    const answer = await fetch(path, options), text = await answer.text();
    let content; try { content = JSON.parse(text); } catch { content = {error: text}; }
    if (!answer.ok) { say.textContent = content.error; return; }
    state = content; show();
  } catch { say.textContent = "uwblite view has ended; start it again and reload this page"; }
}
function status() {
  const job = state.job;
  if (job && job.code === null) return "mapping again ... " + job.output;
  if (job && job.code !== 0 && job.code !== 3) return "the map was not made: " + job.output;
  if (job && job.code === 3) return "mapped again; the result is doubted, see there";
  return state.edits ? state.edits + " changes in " + state.constraints : "click a closure or an anchor to correct it";
}
function show() {
  say.textContent = status();
  main.replaceChildren(...state.results.map(card));
  highlight();
  clearTimeout(timer);
  if (state.job && state.job.code === null) timer = setTimeout(() => ask("/state"), 1000);
}
function card(result, number) {
  const detail = el("div", {class: "detail"}), busy = state.job && state.job.code === null ? {disabled: ""} : {};
  const open = (tell, which) =>
    choose(number, detail, d => tell(d, number, which), tell === tellClosure ? which : null);
  const box = el("div"), svg = drawnMap(box, result.svg), [kept, rejected] = svg.querySelectorAll(".closure");
  const lines = new Map([...svg.querySelectorAll("[data-closure]")].map(line => [Number(line.dataset.closure), line]));
  for (const c of result.closures) {
    const line = lines.get(c.number), hit = line.cloneNode(true);
    line.classList.add(c.wish);
    hit.classList.add("hit");
    (c.wish === "leave" ? line.parentNode : kept).append(line, hit);
    for (const node of [line, hit]) node.addEventListener("click", () => open(tellClosure, c.number));
  }
  svg.querySelectorAll("[data-anchor]").forEach(node => {
    const anchor = result.anchors[node.dataset.anchor];
    node.classList.toggle("pinned", Boolean(anchor.pinned));
    node.addEventListener("click", () => open(tellAnchor, anchor.id));
  });
  const switched = el("input", {type: "checkbox", style: "width:auto", onchange: e => rejected.classList.toggle("hidden",
    !e.target.checked)});
  const facts = [result.recordings.join(", "), result.settings, result.accepted + " of " + result.candidates +
    " closures accepted", result.anchors.length + " anchors"].filter(Boolean).join(" · ");
  const paths = result.recordings.length < 2 ? [key("path0", "path")]
    : result.recordings.slice(0, 4).map((_, k) => key("path" + k, "recording " + (k + 1)));
  const link = (name, text) => el("a", {href: `/result/${number}/${name}`, target: "_blank", rel: "noopener"}, text);
  if (chosen && chosen.result === number) chosen.tell(detail); else hint(detail);
  return el("section", {}, el("h2", {}, result.name), el("div", {class: "faint"}, facts),
    ...result.doubts.map(text => el("div", {class: "doubt"}, "Doubt: " + text)), box,
    el("div", {class: "row faint"}, ...paths, key("start", "start", "disc"), key("path0", "end", "ring"),
      ...(result.anchors.length ? [key("anchor", "anchor, 2σ", "anchors")] : []), key("accepted", "closure accepted"),
      el("label", {}, switched, " ", key("rejected", "rejected")), key("start", "forced, pinned"),
      key("ink", "rejected by you")),
    detail, el("div", {class: "row"},
      el("button", {class: "main map-again", onclick: () => ask("/map", {result: number}), ...busy}, "Map again"),
      link("report.html", "report"), link("map.png", "picture")),
    el("details", {}, el("summary", {}, "All closures"), el("div", {class: "list"}, el("table", {},
      ...result.closures.slice(0, 400).map(c => el("tr", {}, el("td", {}, c.stamps.map(t => t.toFixed(1)).join(" – ") + " s"),
        el("td", {}, {leave: c.accepted ? "accepted" : "rejected", force: "forced", reject: "rejected by you"}[c.wish]),
        el("td", {}, el("button", {onclick: () => open(tellClosure, c.number)}, "choose"))))))));
}
function hint(detail) { detail.replaceChildren(el("span", {class: "faint"}, "Nothing chosen.")); }
function choose(result, detail, tell, closure) {
  chosen = {result, tell, closure};
  tell(detail);
  highlight();
}
function highlight() {
  document.querySelectorAll(".chosen").forEach(node => node.classList.remove("chosen"));
  if (chosen && chosen.closure !== null)
    main.children[chosen.result].querySelector(`[data-closure="${chosen.closure}"]:not(.hit)`).classList.add("chosen");
}
function tellClosure(detail, number, k) {
  const c = state.results[number].closures.find(c => c.number === k);
  if (!c) return hint(detail);
  const button = (wish, text) => el("button", {"data-wish": wish, ...(c.wish === wish ? {disabled: ""} : {}),
    onclick: () => ask("/closure", {result: number, number: k, wish})}, text);
  const times = c.stamps.map((t, i) => t.toFixed(2) + " s" + (c.recordings[i] > 1 ? " of recording " + c.recordings[i] : ""));
  detail.replaceChildren(
    el("div", {}, `Closure at ${times.join(" and ")}: ${c.accepted ? "accepted" : "rejected"}, ${c.reason}`),
    el("div", {class: "row"}, button("reject", "Reject"), button("force", "Force"), button("leave", "Leave it to the mapper")));
}
function tellAnchor(detail, number, id) {
  const a = state.results[number].anchors.find(a => a.id === id);
  if (!a) return hint(detail);
  const [x, y] = (a.pinned || a.place).map((v, k) => el("input", {value: v.toFixed(3), "aria-label": "xy"[k]}));
  const sigma = a.sigma ? " ± " + meters(a.sigma).join(", ") : "", [px, py] = meters(a.place);
  const pin = place => () => ask("/anchor", {result: number, id, place: place && place.map(v => Number(v.value))});
  detail.replaceChildren(
    el("div", {}, `Anchor ${id} (${a.status}) at x ${px} m, y ${py} m${sigma}${a.pinned ? ", pinned" : ""}`),
    el("div", {class: "row"}, "x", x, "y", y, "m", el("button", {"data-wish": "pin", onclick: pin([x, y])}, "Pin here"),
      el("button", {"data-wish": "free", ...(a.pinned ? {} : {disabled: ""}), onclick: pin(null)}, "Free")));
}
ask("/state");
"""

_LIVE_STYLE = """
.faint{font-size:.9rem}section{overflow-x:auto;overflow-wrap:anywhere}
.trail{fill:none;stroke:var(--start);stroke-width:calc(var(--s)*2px)}
.robot path{fill:var(--start);stroke:#fff;stroke-width:1px;transform:scale(var(--s))}
.lost path{fill-opacity:.35;stroke:var(--start)}#robot ellipse{fill:var(--start);stroke:var(--start)}
ol{margin:0;padding-left:1.3rem}li{margin:.2rem 0}ol li:first-child{font-weight:600}
@media (min-width:60rem){main{grid-template-columns:2fr 1fr}.picture{grid-column:1;grid-row:1/span 9}}
table{font-size:.85rem;overflow-wrap:normal}td,th{white-space:nowrap}td small{display:block;color:var(--faint)}
"""

_LIVE_SCRIPT = r"""
const at = id => document.getElementById(id);
let map = null, now = null;
function shape(name, attrs, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [k, v] of Object.entries(attrs)) node.setAttribute(k, v);
  node.append(...children);
  return node;
}
const there = ([x, y], turn) => `translate(${x} ${-y}) rotate(${-turn})`;
const arrow = (pose, name) => shape("g", {class: name, transform: there(pose, pose[2] * 180 / Math.PI)},
  shape("path", {d: "M15 0L-10 10L-5 0L-10-10Z"}));
function show() {
  const svg = drawnMap(at("map"), map.svg);
  if (svg) svg.append(shape("g", {id: "robot"}));
  at("legend").hidden = !svg;
  at("path").hidden = !svg || !svg.querySelector(".trajectory polyline");
  at("facts").textContent = map.accepted + " of " + map.candidates + " loop closures accepted";
  at("notes").replaceChildren(...map.doubts.map(t => el("li", {}, "Doubt: " + t)), ...map.warnings.map(t => el("li", {}, t)));
  at("notes").parentNode.hidden = !map.doubts.length && !map.warnings.length;
  robot();
  anchors();
}
function robot() {
  const layer = at("robot");
  if (layer) layer.replaceChildren();
  if (!layer || !now || !now.pose) return;
  const view = layer.ownerSVGElement.viewBox.baseVal, trail = now.trail || [];
  for (const [x, y] of [now.pose, ...trail]) {
    const left = Math.min(view.x, x - 1), top = Math.min(view.y, -y - 1);
    const right = Math.max(view.x + view.width, x + 1), bottom = Math.max(view.y + view.height, 1 - y);
    Object.assign(view, {x: left, y: top, width: right - left, height: bottom - top});
  }
  rescale(layer.ownerSVGElement);
  if (now.ellipse) {
    const [rx, ry, turn] = now.ellipse;
    layer.append(shape("ellipse", {rx, ry, transform: there(now.pose, turn)}));
  }
  layer.append(shape("polyline", {class: "trail", points: trail.map(([x, y]) => x + "," + -y).join(" ")}),
    ...(now.alternatives || []).map(p => arrow(p, "robot lost")), arrow(now.pose, now.lost ? "robot lost" : "robot"));
}
function rows(names, lines) {
  return [el("tr", {}, ...names.map(n => el("th", {}, n))), ...lines.map(([late, ...cells]) => el("tr", late
    ? {class: "bad"} : {}, ...cells.map(c => el("td", {}, c))))];
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
  const box = at("advice"), list = now.advice || [], sensors = now.sensors || [], silent = sensors.some(s => s.late);
  box.className = now.late ? "bad" : list.length ? "warn" : "good";
  box.replaceChildren(list.length ? el("ol", {}, ...list.map(t => el("li", {}, t)))
    : el("div", {}, now.fine || "Nothing to do: go on driving."));
  at("sensors").replaceChildren(...rows(["sensor", "messages", "per second", ...(silent ? ["silent"] : [])], sensors.map(s =>
    [s.late, s.name, s.count, s.rate, ...(silent ? [s.late ? s.silent + " s" : ""] : [])])));
  at("sensors").parentNode.hidden = !sensors.length;
  robot();
  anchors();
}
const source = new EventSource("/events");
source.addEventListener("status", e => { now = JSON.parse(e.data); status(); });
source.addEventListener("map", e => { map = JSON.parse(e.data); show(); });
source.onopen = () => { at("lost").hidden = true; };
source.onerror = () => { at("lost").hidden = false; };
"""


def view_page(token: str) -> str:
    """Return the page of results; the token lets its own posts in, and no other page's."""
    header = '<header><h1>uwblite view</h1><span id="say" role="status">loading ...</span></header>'
    body = f'{header}<main data-token="{token}"></main>'
    return document("uwblite view", body, _STYLE + _VIEW_STYLE, SCALED + _SCRIPT + _VIEW_SCRIPT, head="")


def live_page(title: str) -> str:
    """Return the page of a map that grows or a robot that moves on it, which server-sent events keep up to date."""
    name = escape(title)
    keys = (key("path0", "path"), key("start", "robot", "arrow"), key("anchor", "anchor, 2\u03c3", "anchors"))
    path, robot, anchor = (f"<span>{entry}</span>" for entry in keys)
    body = (
        f'<header><h1>{name}</h1><div id="summary" class="faint" role="status">loading ...</div>'
        '<div id="lost" class="bad" hidden>No connection; the page tries again by itself.</div></header><main>'
        '<section id="advice" aria-live="polite"></section><section class="picture"><div id="map"></div>'
        f'<div id="legend" class="row faint" hidden><span id="path">{path}</span>{robot}{anchor}</div>'
        '<div id="facts" class="faint">There is no map yet.</div>'
        '</section><section hidden><h2>Sensors</h2><table id="sensors"></table></section>'
        '<section hidden><h2>Anchors</h2><table id="anchors"></table></section>'
        '<section hidden><h2>Of the latest map</h2><ul id="notes"></ul></section></main>'
    )
    return document(name, body, _STYLE + _LIVE_STYLE, SCALED + _SCRIPT + _LIVE_SCRIPT, head="")
