"""What the pages of this package have in common: their frame, colours and elements, and how a map is drawn.

The scripts build everything with text nodes, so that no name out of a recording becomes markup.
"""

import html

from ..report.page import coloured

_STYLE = """
:root{--paper:#f6f7f9;--card:#fff;--ink:#1f2733;--faint:#6b7482;--line:#d8dde4;--path:@path@;--anchor:@anchor@;
--start:@start@;--warn:#fff4e0}
@media (prefers-color-scheme:dark){:root{--paper:#14181e;--card:#1d232b;--ink:#e4e8ee;--faint:#98a2b0;--line:#36404c;
--path:@path-dark@;--anchor:@anchor-dark@;--start:@start-dark@;--warn:#3a2f1a}}
*{box-sizing:border-box}body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.45 system-ui,sans-serif}
header{position:sticky;top:0;z-index:2;padding:.5rem 1rem;background:var(--card);border-bottom:1px solid var(--line)}
h1{font-size:1.1rem;margin:0}h2{font-size:1rem;margin:0 0 .3rem}
main{display:grid;gap:.8rem;padding:.8rem;grid-template-columns:repeat(auto-fit,minmax(min(100%,25rem),1fr))}
section{background:var(--card);border:1px solid var(--line);border-radius:.5rem;padding:.8rem;min-width:0}
table{border-collapse:collapse;width:100%}th{color:var(--faint)}
td,th{text-align:left;padding:.15rem .5rem .15rem 0;font-weight:400}
.path{fill:none;stroke:var(--path);stroke-width:2;vector-effect:non-scaling-stroke}
.p1{stroke:@path1@}.p2{stroke:@path2@}.p3{stroke:@path3@}
.anchor{fill:var(--anchor)}.anchor text{font-weight:600}
.anchor text,.bar text{paint-order:stroke;stroke:#fff;stroke-width:.15em}
.bar path{stroke:var(--ink);stroke-width:3;vector-effect:non-scaling-stroke}.bar text{fill:var(--ink)}
image{image-rendering:pixelated}svg{display:block;width:100%;background:#cdcdcd;border-radius:.3rem}svg:empty{display:none}
.key{display:inline-block;width:1.2rem;border-top:3px solid;vertical-align:middle}
.key.disc{width:.7rem;height:.7rem;border:0;border-radius:50%;background:currentColor}
.key.ring{width:.7rem;height:.7rem;border:2px solid;border-radius:50%}
.key.anchors{width:0;border:.4rem solid transparent;border-top:0;border-bottom:.7rem solid}
.key.arrow{width:0;border:.4rem solid transparent;border-right:0;border-left:.8rem solid}
.row{display:flex;flex-wrap:wrap;gap:.5rem;align-items:center}.faint{color:var(--faint)}
@media (prefers-color-scheme:dark){svg{background:#2a2a2a}.anchor text,.bar text{stroke:#000}
image{filter:invert(1) hue-rotate(180deg) brightness(.85)}}
"""

_SCRIPT = r"""
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
const beside = {right: [1.2, .5, "start"], left: [-1.2, .5, "end"], below: [0, 2.2, "middle"], above: [0, -1.7, "middle"]};
function anchorMark(id, place, side, size) {
  const [x, y, anchor] = beside[side];
  const node = shape("g", {transform: "translate(" + place[0] + " " + -place[1] + ") scale(" + size / 60 + ")",
    class: "anchor"});
  node.append(shape("title", {}, "anchor " + id), shape("path", {d: "M0-1L.9.6H-.9z"}),
    shape("text", {x, y, "text-anchor": anchor, "font-size": 1.6}, id));
  return node;
}
function drawMap(svg, points, anchors, image, href, margin) {  // with room for the names to the right of anchors
  points = points.concat(anchors.map(a => a.place));
  if (image) points.push([image.x, image.y], [image.x + image.width, image.y + image.height]);
  if (!points.length) points.push([0, 0]);
  const xs = points.map(p => p[0]), ys = points.map(p => p[1]), least = Math.min(...xs), low = Math.min(...ys);
  const wide = Math.max(Math.max(...xs) - least, Math.max(...ys) - low);
  for (const a of anchors) xs.push(a.place[0] + .12 * wide);
  const x0 = least - margin, x1 = Math.max(...xs) + margin, y0 = low - margin, y1 = Math.max(...ys) + margin;
  const size = Math.max(x1 - x0, y1 - y0);
  svg.setAttribute("viewBox", [x0, -y1, x1 - x0, y1 - y0].join(" "));
  svg.replaceChildren(...(image ? [shape("image", {href, x: image.x, y: -image.y - image.height, width: image.width,
    height: image.height, preserveAspectRatio: "none"})] : []));
  return {x0, x1, y0, y1, size, bar: scaleBar(x0 + size / 40, -y0 - size / 40, size)};
}
const line = points => points.map(p => p[0] + "," + -p[1]).join(" ");
const drawn = paths => paths.map((path, k) => shape("polyline", {class: "path p" + k % 4, points: line(path)}));
function scaleBar(x, y, size) {
  const power = 10 ** Math.floor(Math.log10(size / 5)), length = power * [5, 2, 1].find(n => n * power <= size / 5);
  const node = shape("g", {class: "bar"});
  node.append(shape("path", {d: `M${x} ${y}h${length}`}),
    shape("text", {x, y: y - size / 80, "font-size": size / 38}, length + " m"));
  return node;
}
"""
"""The y of places is upwards, as in a map; `size` is the larger edge of what is drawn, m, and `side` where a name stands."""
NAME_HEIGHT = 1.6 / 60.0
"""Of an anchor's name, as a share of that edge."""


def document(title: str, style: str, header: str, main: str, script: str, token: str = "") -> str:
    """Return a page, its own style and script after those that all pages share.

    Parameters
    ----------
    header : markup beside the title.
    token : at `document.body.dataset.token` for the script.
    """
    name = html.escape(title)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{name}</title><link rel=icon href=data:,><style>{coloured(_STYLE + style)}</style></head>"
        f'<body data-token="{token}"><header><h1>{name}</h1>{header}</header><main>{main}</main>'
        f"<script>{_SCRIPT}{script}</script></body></html>"
    )
