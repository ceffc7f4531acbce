"""The page of `uwblite view`, from which closures and anchors are corrected and the map is made again."""

from .drawing import document

_STYLE = """
:root{--accent:#2563eb;--accepted:@accepted@;--rejected:@rejected@}@media (prefers-color-scheme:dark){:root{
--accent:#7aa5ff;--accepted:@accepted-dark@;--rejected:@rejected-dark@}}
header{display:flex;flex-wrap:wrap;gap:.6rem 1rem;align-items:center}#say{color:var(--faint);flex:1 1 12rem}
svg{max-height:62vh;touch-action:none}.closure{stroke:var(--accepted);stroke-width:1.6;cursor:pointer}
.closure.no{stroke:var(--rejected);stroke-dasharray:4 3}.closure.force{stroke:var(--start);stroke-width:3}
.closure.reject{stroke:var(--ink);stroke-width:3;stroke-dasharray:2 4}
.hit{stroke:transparent;stroke-width:12;cursor:pointer}line.chosen{stroke-width:5}
circle.chosen{stroke:var(--ink);stroke-width:2}.closure,.hit,circle{vector-effect:non-scaling-stroke}
.hideno .no{display:none}.anchor{cursor:pointer}.anchor.pinned{fill:var(--start)}
.start,.end{pointer-events:none}.start{fill:var(--start)}.end{fill:var(--card);stroke:var(--path);stroke-width:2}
.end.p1{stroke:@path1@}.end.p2{stroke:@path2@}.end.p3{stroke:@path3@}
button,input{font:inherit;border:1px solid var(--line);border-radius:.4rem;background:var(--card);color:inherit}
button{padding:.35rem .8rem;cursor:pointer;min-height:2.4rem}input{width:6rem;padding:.25rem}
button.main{background:var(--accent);border-color:var(--accent);color:#fff}button:disabled{opacity:.5;cursor:default}
@media (prefers-color-scheme:dark){button.main{color:#10151c}}
.detail{min-height:5.2rem;padding:.5rem 0;border-top:1px solid var(--line);margin-top:.6rem}
.doubt{background:var(--warn);border-radius:.3rem;padding:.4rem .6rem;margin:.4rem 0}a{color:var(--accent)}
.list{max-height:16rem;overflow:auto;border-top:1px solid var(--line);margin-top:.5rem}
.list button{min-height:0;padding:.1rem .5rem}
.key.p1{color:@path1@}.key.p2{color:@path2@}.key.p3{color:@path3@}
"""

_SCRIPT = r"""
const say = document.getElementById("say"), main = document.querySelector("main");
let state = null, chosen = null, timer = 0;
async function ask(path, wish) {
  const options = wish ? {method: "POST", body: JSON.stringify(wish),
    headers: {"Content-Type": "application/json", "X-Token": document.body.dataset.token}} : {};
  try {
    const answer = await fetch(path, options);
    const text = await answer.text();
    let content; try { content = JSON.parse(text); } catch { content = {error: text}; }
    if (!answer.ok) { say.textContent = content.error; return; }
    state = content; show();
  } catch { say.textContent = "uwblite view has ended; start it again and reload this page"; }
}
const clock = (result, k) => result.closures.find(c => c.number === k);
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
  const detail = el("div", {class: "detail"}), busy = state.job && state.job.code === null;
  const facts = [result.recordings.join(", "), result.settings, result.accepted + " of " + result.candidates +
    " closures accepted", result.anchors.length + " anchors"].filter(Boolean).join(" · ");
  const svg = picture(result, number, detail);
  const rejected = el("input", {type: "checkbox", style: "width:auto", onchange: e => svg.classList.toggle("hideno",
    !e.target.checked)});
  const paths = result.paths.length < 2 ? [key("path", "path")] : result.paths.slice(0, 4).map((_, k) => el("span", {}, el("i",
    {class: "key p" + k, ...(k ? {} : {style: "color:var(--path)"})}), " recording " + (k + 1)));
  const node = el("section", {}, el("h2", {}, result.name), el("div", {class: "faint"}, facts));
  for (const text of result.doubts) node.append(el("div", {class: "doubt"}, "Doubt: " + text));
  node.append(svg, el("div", {class: "row faint"}, ...paths, key("start", "start", "disc"), key("path", "end", "ring"),
    ...(result.anchors.length ? [key("anchor", "anchor", "anchors")] : []), key("accepted", "closure accepted"),
    el("label", {}, rejected, " ", key("rejected", "rejected")), key("start", "forced, pinned"), key("ink",
      "rejected by you")));
  node.append(detail, el("div", {class: "row"},
    el("button", {class: "main map", onclick: () => ask("/map", {result: number}), ...(busy ? {disabled: ""} : {})},
      "Map again"),
    el("a", {href: "/result/" + number + "/report.html", target: "_blank", rel: "noopener"}, "report"),
    el("a", {href: "/result/" + number + "/map.png", target: "_blank", rel: "noopener"}, "picture")));
  node.append(table(result, number, detail));
  if (chosen && chosen.result === number) chosen.tell(detail); else hint(detail);
  return node;
}
function hint(detail) { detail.replaceChildren(el("span", {class: "faint"}, "Nothing chosen.")); }
function picture(result, number, detail) {
  const svg = shape("svg", {class: "hideno", role: "img", "aria-label": "map of " + result.name});
  const placed = result.anchors.filter(a => a.place);
  const {size, bar} = drawMap(svg, result.paths.flat(), placed, result.image, "/result/" + number + "/grid.png", .5);
  svg.append(...drawn(result.paths));
  for (const c of result.closures.slice().reverse()) {
    const [a, b] = c.places, ends = {x1: a[0], y1: -a[1], x2: b[0], y2: -b[1]};
    const mark = " " + (c.accepted || c.wish !== "leave" ? "" : "no") + " " + c.wish;
    const stroke = shape("line", {...ends, class: "closure" + mark, "data-closure": c.number});
    const hit = shape("line", {...ends, class: "hit" + mark});
    const open = () => choose(number, detail, d => tellClosure(d, result, number, c.number), `[data-closure="${c.number}"]`);
    for (const node of [stroke, hit]) node.addEventListener("click", open);
    svg.append(stroke, hit);
  }
  result.paths.forEach((path, k) => {
    const mark = (at, name) => shape("circle", {cx: at[0], cy: -at[1], r: size / 110, class: name});
    if (path.length) svg.append(mark(path[0], "start"), mark(path[path.length - 1], "end p" + k % 4));
  });
  for (const a of placed) {
    const node = anchorMark(a.id, a.place, a.side, size);
    node.classList.toggle("pinned", Boolean(a.pinned));
    node.dataset.anchor = a.id;
    node.addEventListener("click", () => choose(number, detail, d => tellAnchor(d, result, number, a.id), null));
    svg.append(node);
  }
  svg.append(bar);
  return svg;
}
function choose(number, detail, tell, mark) {
  chosen = {result: number, tell, mark};
  tell(detail);
  highlight();
}
function highlight() {
  document.querySelectorAll(".chosen").forEach(node => node.classList.remove("chosen"));
  if (chosen && chosen.mark) document.querySelectorAll("section")[chosen.result].querySelectorAll(chosen.mark)
    .forEach(node => node.classList.add("chosen"));
}
function tellClosure(detail, result, number, k) {
  const c = clock(state.results[number], k);
  if (!c) return hint(detail);
  const button = (wish, text) => el("button", {"data-wish": wish, ...(c.wish === wish ? {disabled: ""} : {}),
    onclick: () => ask("/closure", {result: number, number: k, wish})}, text);
  detail.replaceChildren(el("div", {}, "Closure at " + c.stamps.map((t,
    i) => t.toFixed(2) + " s" + (c.recordings[i] > 1 ? " of recording "
    + c.recordings[i] : "")).join(" and ") + ": " + (c.accepted ? "accepted" : "rejected") + ", " + c.reason),
    el("div", {class: "row"}, button("reject", "Reject"), button("force", "Force"), button("leave",
      "Leave it to the mapper")));
}
function tellAnchor(detail, result, number, id) {
  const a = state.results[number].anchors.find(a => a.id === id);
  if (!a) return hint(detail);
  const place = a.pinned || a.place, x = el("input", {value: place[0].toFixed(3), "aria-label": "x"});
  const y = el("input", {value: place[1].toFixed(3), "aria-label": "y"});
  const sigma = a.sigma ? " ± " + a.sigma.map(v => v.toFixed(2)).join(", ") : "";
  const [px, py] = a.place.map(v => v.toFixed(2) + " m"), pinned = a.pinned ? ", pinned" : "";
  const pin = () => ask("/anchor", {result: number, id, place: [Number(x.value), Number(y.value)]});
  const free = () => ask("/anchor", {result: number, id, place: null});
  detail.replaceChildren(
    el("div", {}, "Anchor " + a.id + " (" + a.status + ") at x " + px + ", y " + py + sigma + pinned),
    el("div", {class: "row"}, "x", x, "y", y, "m", el("button", {"data-wish": "pin", onclick: pin}, "Pin here"),
      el("button", {"data-wish": "free", ...(a.pinned ? {} : {disabled: ""}), onclick: free}, "Free")));
}
function table(result, number, detail) {
  const rows = result.closures.slice(0, 400).map(c => el("tr", {}, el("td", {},
    c.stamps.map(t => t.toFixed(1)).join(" – ") + " s"),
    el("td", {}, c.wish === "leave" ? (c.accepted ? "accepted" : "rejected") : c.wish === "force"
      ? "forced" : "rejected by you"),
    el("td", {}, el("button", {onclick: () => choose(number, detail, d => tellClosure(d, result, number, c.number),
      `[data-closure="${c.number}"]`)},
      "choose"))));
  return el("details", {}, el("summary", {}, "All closures"), el("div", {class: "list"}, el("table", {}, ...rows)));
}
ask("/state");
"""


def page(token: str) -> str:
    """Return the page; the token lets its own posts in, and no other page's."""
    return document("uwblite view", _STYLE, '<span id="say" role="status">loading ...</span>', "", _SCRIPT, token)
