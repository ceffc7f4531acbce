"""What the pages of this package draw alike: elements, anchors, and the scale bar of a map."""

STYLE = """
.anchor{fill:var(--anchor)}.anchor text{paint-order:stroke;stroke:#fff;stroke-width:.15em;font-weight:600}
.bar path{stroke:var(--ink);stroke-width:3;vector-effect:non-scaling-stroke}.bar text{fill:var(--ink)}
image{image-rendering:pixelated}svg{display:block;width:100%;background:#cdcdcd;border-radius:.3rem}
.key{display:inline-block;width:1.2rem;border-top:3px solid;vertical-align:middle}
.key.disc{width:.7rem;height:.7rem;border:0;border-radius:50%;background:currentColor}
.key.ring{width:.7rem;height:.7rem;border:2px solid;border-radius:50%}
.key.anchors{width:0;border:.4rem solid transparent;border-top:0;border-bottom:.7rem solid}
.row{display:flex;flex-wrap:wrap;gap:.5rem;align-items:center}.faint{color:var(--faint)}
@media (prefers-color-scheme:dark){svg{background:#2a2a2a}.anchor text{stroke:#000}
image{filter:invert(1) hue-rotate(180deg) brightness(.85)}}
"""

SCRIPT = r"""
"use strict";
const NS = "http://www.w3.org/2000/svg";
function el(name, attrs = {}, ...children) {
  const node = document.createElement(name);
  for (const [k, v] of Object.entries(attrs)) k.startsWith("on") ? node.addEventListener(k.slice(2),
    v) : node.setAttribute(k, v);
  node.append(...children);
  return node;
}
function shape(name, attrs, text = "") {
  const node = document.createElementNS(NS, name);
  for (const [k, v] of Object.entries(attrs)) node.setAttribute(k, v);
  node.textContent = text;
  return node;
}
const key = (name, text, form = "") => el("span", {}, el("i", {class: "key " + form, style: "color:var(--" + name + ")"}),
  " " + text);
function anchorMark(id, place, size) {
  const node = shape("g", {transform: "translate(" + place[0] + " " + -place[1] + ") scale(" + size / 60 + ")",
    class: "anchor"});
  node.append(shape("title", {}, "anchor " + id), shape("path", {d: "M0-1L.9.6H-.9z"}),
    shape("text", {x: 1.2, y: .5, "font-size": 1.6}, id));
  return node;
}
function makeRoom(xs, ys, anchors) {  // for the names, to the right of their anchors
  const size = Math.max(Math.max(...xs) - Math.min(...xs), Math.max(...ys) - Math.min(...ys));
  for (const a of anchors) if (a.place) xs.push(a.place[0] + .12 * size);
}
function scaleBar(x, y, size) {
  const power = 10 ** Math.floor(Math.log10(size / 5)), length = power * [5, 2, 1].find(n => n * power <= size / 5);
  const node = shape("g", {class: "bar"});
  node.append(shape("path", {d: `M${x} ${y}h${length}`}),
    shape("text", {x, y: y - size / 80, "font-size": size / 38}, length + " m"));
  return node;
}
"""
"""The y of places is upwards, as in a map; `size` is the larger edge of what is drawn, m."""
