"""The frame of all pages: colours and style, the style of a map's SVG, and the script that zooms the report's map."""

from .canvas import PALETTE

_LIGHT, _DARK = ("".join(f"--{name}:#{codes[ground]};" for name, codes in PALETTE.items()) for ground in (0, 1))

STYLE = (
    ":root{--paper:#f6f7f9;--card:#fff;--ink:#1b1f24;--faint:#667;--line:#d5d9de;--shade:#0003;--good:#e7f5e9;--warn:#fff4d6;"
    "--bad:#fde4e1;--unsure:#ef6c00;--halo:#fff;--ground:#cdcdcd;" + _LIGHT + "}@media (prefers-color-scheme:dark){"
    ":root{--paper:#14181e;--card:#1a1f26;--ink:#e4e7eb;--faint:#9aa3ad;--line:#3a4049;--shade:#fff4;--good:#17301b;"
    "--warn:#3a2f10;--bad:#451c19;--unsure:#ffa040;--halo:#000;--ground:#2a2a2a;" + _DARK + "}"
    ".map image{filter:invert(1) hue-rotate(180deg) brightness(.85)}}"
    """
*{box-sizing:border-box}
body{margin:0;background:var(--card);color:var(--ink);font:16px/1.45 system-ui,sans-serif}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.9rem}
td,th{text-align:left;vertical-align:top}
.key{display:inline-block;width:1.2rem;border-top:3px solid;vertical-align:middle}
.key.disc{width:.7rem;height:.7rem;border:0;border-radius:50%;background:currentColor}
.key.ring{width:.7rem;height:.7rem;border:2px solid;border-radius:50%}
.key.anchors{width:0;border:.4rem solid transparent;border-top:0;border-bottom:.7rem solid}
.key.arrow{width:0;border:.4rem solid transparent;border-right:0;border-left:.8rem solid}
.good{background:var(--good)}.warn{background:var(--warn)}.bad{background:var(--bad)}.hidden{display:none}
.map{display:block;width:100%;max-height:80vh;background:var(--ground);border-radius:.4rem}
.map image{image-rendering:pixelated}
.map text{font-size:calc(var(--s)*14px);fill:var(--ink);paint-order:stroke;stroke:var(--halo);stroke-width:calc(var(--s)*4px)}
.trajectory polyline{fill:none;stroke:var(--path0);stroke-width:calc(var(--s)*2px);stroke-linejoin:round}
.trajectory .path1{stroke:var(--path1)}.trajectory .path2{stroke:var(--path2)}.trajectory .path3{stroke:var(--path3)}
.trajectory .doubted{stroke:var(--doubted);stroke-width:calc(var(--s)*7px);opacity:.6}
.trajectory .end{fill:#fff;stroke:var(--path0);r:calc(var(--s)*5px);stroke-width:calc(var(--s)*3px)}
.trajectory .start{fill:var(--start);stroke:#fff;r:calc(var(--s)*5px);stroke-width:calc(var(--s)*1px)}
.anchor path{fill:var(--anchor);stroke:#fff;stroke-width:1px;transform:scale(var(--s))}
.anchor text{fill:var(--anchor);font-weight:600;text-anchor:middle;transform:translateY(calc(var(--s)*19px))}
.anchor .above{transform:translateY(calc(var(--s)*-15px))}
.anchor .right{text-anchor:start;transform:translate(calc(var(--s)*10px),calc(var(--s)*4px))}
.anchor .left{text-anchor:end;transform:translate(calc(var(--s)*-10px),calc(var(--s)*4px))}
.anchor.doubt path{fill:var(--unsure)}
.map ellipse{fill:var(--anchor);fill-opacity:.2;stroke:var(--anchor);stroke-width:calc(var(--s)*1px)}
.mirror{fill:none;stroke:var(--unsure);r:calc(var(--s)*8px);stroke-width:calc(var(--s)*2px);stroke-dasharray:calc(var(--s)*4px)}
.bar path{stroke:var(--ink);stroke-width:calc(var(--s)*3px)}
.closure{fill:none;stroke:var(--accepted);stroke-width:calc(var(--s)*1.5px);stroke-linecap:round}
.closure polyline{opacity:.45}.closure polyline:hover{stroke-width:calc(var(--s)*6px);opacity:1}
.closure.rejected{stroke:var(--rejected);stroke-dasharray:calc(var(--s)*5px)}
"""
)
"""Of all pages; where a map's SVG stands, --s is metres per pixel, and marks keep their size."""

SCALED = """
"use strict";
const rescale = svg => svg.style.setProperty("--s", 1 / svg.getScreenCTM().a);
const scaled = svg => new ResizeObserver(() => rescale(svg)).observe(svg);
"""
"""Script: keeps the size of a map's marks."""

ZOOM = """
const svg = document.querySelector(".map"), view = svg.viewBox.baseVal, pointers = new Map();
const whole = [view.x, view.y, view.width, view.height];
const point = event => new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
const middle = () => ({x: view.x + view.width / 2, y: view.y + view.height / 2});
const press = (id, action) => document.getElementById(id).addEventListener("click", action);
function look(x, y, width, height) {
  Object.assign(view, {x, y, width, height});
  rescale(svg);
}
function zoom(at, factor) {
  if (view.width * factor > whole[2] * 3 || view.width * factor < whole[2] / 400) return;
  look(at.x - (at.x - view.x) * factor, at.y - (at.y - view.y) * factor, view.width * factor, view.height * factor);
}
document.querySelectorAll("[data-layer]").forEach(box => box.addEventListener("change", () =>
  svg.querySelectorAll("." + box.dataset.layer).forEach(layer => layer.classList.toggle("hidden", !box.checked))));
svg.addEventListener("wheel", event => {
  event.preventDefault();
  zoom(point(event), event.deltaY > 0 ? 1.2 : 1 / 1.2);
}, {passive: false});
svg.addEventListener("pointerdown", event => {
  svg.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, event);
});
svg.addEventListener("pointermove", event => {
  const here = point(event), before = pointers.get(event.pointerId);
  document.getElementById("place").textContent = `x ${here.x.toFixed(2)} m, y ${(-here.y).toFixed(2)} m`;
  if (!before) return;
  if (pointers.size === 2) {
    const other = [...pointers.values()].find(p => p.pointerId !== event.pointerId);
    const apart = p => Math.hypot(p.clientX - other.clientX, p.clientY - other.clientY);
    if (apart(before) > 0 && apart(event) > 0) zoom(point(other), apart(before) / apart(event));
  } else {
    const from = point(before);
    look(view.x + from.x - here.x, view.y + from.y - here.y, view.width, view.height);
  }
  pointers.set(event.pointerId, event);
});
["pointerup", "pointercancel"].forEach(name => svg.addEventListener(name, event => pointers.delete(event.pointerId)));
press("zoom-in", () => zoom(middle(), 1 / 1.5));
press("zoom-out", () => zoom(middle(), 1.5));
press("zoom-all", () => look(...whole));
scaled(svg);
"""
"""Script of the report: layers are shown and hidden, the wheel, two fingers and buttons zoom, dragging moves."""

POLICY = (
    '<meta http-equiv="Content-Security-Policy"'
    " content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'\">"
)
"""Of a page in a file: nothing comes from elsewhere."""


def document(title: str, body: str, style: str = "", script: str = "", head: str = POLICY) -> str:
    """Return a page from markup; style and script are its own, after those of all pages."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'{head}<meta name="color-scheme" content="light dark"><link rel="icon" href="data:,"><title>{title}</title>'
        f"<style>{STYLE}{style}</style></head><body>{body}<script>(() => {{{script}}})();</script></body></html>\n"
    )


def key(colour: str, text: str, form: str = "") -> str:
    """Return an entry of a legend as markup; colour and form are names of the style."""
    return f'<i class="key {form}" style="color:var(--{colour})"></i> {text}'
