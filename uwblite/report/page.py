"""The frame of the HTML report: page, style, and the script that zooms the map."""

from . import canvas
from .canvas import hexadecimal

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<meta name="color-scheme" content="light dark">
<link rel="icon" href="data:,">
<title>{title} \u2013 uwblite</title>
<style>{style}</style></head>
<body><main>{body}</main><script>{script}</script></body></html>
"""

_STYLE = """
:root{--bg:#fff;--fg:#1b1f24;--dim:#667;--line:#d5d9de;--path:@path@;--anchor:@anchor@;--kept:@accepted@;--rej:@rejected@;
--shade:#0003;--good:#e7f5e9;--warn:#fff4d6;--bad:#fde4e1;--nlos:@nlos@}
@media (prefers-color-scheme:dark){:root{--bg:#15181c;--fg:#e4e7eb;--dim:#9aa3ad;--line:#3a4049;--path:@path-dark@;
--anchor:@anchor-dark@;--kept:@accepted-dark@;--rej:@rejected-dark@;--shade:#fff4;--good:#17301b;--warn:#3a2f10;--bad:#451c19;--nlos:@nlos-dark@}#map-view{filter:brightness(.85)}}
*{box-sizing:border-box}
body{margin:0;background:var(--bg);color:var(--fg);font:16px/1.45 system-ui,sans-serif}
main{max-width:70rem;margin:0 auto;padding:1rem}
h1{font-size:1.5rem;overflow-wrap:anywhere}h2{font-size:1.15rem;margin:1.6rem 0 .5rem}
.scroll{overflow-x:auto;background:linear-gradient(90deg,var(--bg) 40%,transparent) 0 0/2.5rem 100% local no-repeat,
linear-gradient(270deg,var(--bg) 40%,transparent) 100% 0/2.5rem 100% local no-repeat,
linear-gradient(90deg,var(--shade),transparent) 0 0/.9rem 100% no-repeat,
linear-gradient(270deg,var(--shade),transparent) 100% 0/.9rem 100% no-repeat}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:.9rem}
th,td{text-align:left;padding:.2rem .6rem;border-bottom:1px solid var(--line);vertical-align:top}
td{white-space:nowrap}td.words{white-space:normal;min-width:15rem}
.key{display:inline-block;width:1.1rem;height:.25rem;border-radius:.1rem;vertical-align:middle;background:@path@}
.key.path1{background:@path1@}.key.path2{background:@path2@}.key.path3{background:@path3@}
.key-kept{background:@accepted@}.key-rejected{background:@rejected@}.key-anchors{background:@anchor@}.key-grid{background:#888}
summary{cursor:pointer;padding:.4rem 0}
.facts td{white-space:normal}.facts th{font-weight:500;color:var(--dim);white-space:nowrap}.facts td{overflow-wrap:anywhere}
.box{padding:.6rem .9rem;border-radius:.4rem;margin:.6rem 0}.box ul{margin:.3rem 0;padding-left:1.2rem}
.good{background:var(--good)}.warn{background:var(--warn)}.bad{background:var(--bad)}
.hint{color:var(--dim);font-size:.85rem}.nlos-text{color:var(--nlos)}
pre{background:var(--warn);padding:.6rem;border-radius:.4rem;white-space:pre-wrap;overflow-wrap:anywhere}
.controls{display:flex;flex-wrap:wrap;gap:.3rem .9rem;align-items:center;margin:.4rem 0}
.controls label{white-space:nowrap;padding:.2rem 0}button{font:inherit;min-width:2.2rem;min-height:2.2rem}
.buttons{white-space:nowrap}
.mapbox{border:1px solid var(--line);border-radius:.4rem;overflow:hidden}
#map-view{display:block;width:100%;max-height:80vh;touch-action:none;cursor:grab;background:#cdcdcd}
image.grid{image-rendering:pixelated}
.trajectory polyline{fill:none;stroke:@path@;stroke-width:calc(var(--s)*2px);stroke-linejoin:round}
.trajectory .doubted{stroke:@doubted@;stroke-width:calc(var(--s)*7px);opacity:.6}
.trajectory .s1{stroke:@path1@}.trajectory .s2{stroke:@path2@}.trajectory .s3{stroke:@path3@}
.end{fill:#fff;stroke:@path@;r:calc(var(--s)*5px);stroke-width:calc(var(--s)*3px)}
.start{fill:@start@;stroke:#fff;r:calc(var(--s)*5px);stroke-width:calc(var(--s)*1px)}
.anchor path{fill:@anchor@;stroke:#fff;stroke-width:1px;transform:scale(var(--s))}
.anchor text{text-anchor:middle;transform:translateY(calc(var(--s)*19px))}
.anchor .above{transform:translateY(calc(var(--s)*-15px))}
.anchor .right{text-anchor:start;transform:translateX(calc(var(--s)*10px))}
.anchor .left{text-anchor:end;transform:translateX(calc(var(--s)*-10px))}
.anchor.doubt path{fill:#ef6c00}
.anchor ellipse{fill:@anchor@33;stroke:@anchor@;stroke-width:calc(var(--s)*1px)}
.anchor .mirror{fill:none;stroke:#ef6c00;r:calc(var(--s)*8px);stroke-width:calc(var(--s)*2px);
stroke-dasharray:calc(var(--s)*4px)}
.anchor text,.bar text{font-size:calc(var(--s)*14px);fill:#1b1f24;paint-order:stroke;
stroke:#fff;stroke-width:calc(var(--s)*4px)}
.bar path{stroke:#1b1f24;stroke-width:calc(var(--s)*3px)}
.closure path{fill:none;stroke-width:calc(var(--s)*1.5px);stroke-linecap:round;opacity:.45}
.closure path:hover{stroke-width:calc(var(--s)*6px);opacity:1}
.kept path{stroke:@accepted@}.rejected path{stroke:@rejected@;stroke-dasharray:calc(var(--s)*5px)}
#place{font-variant-numeric:tabular-nums;float:right;color:var(--fg)}
.hidden{display:none}
figure{margin:.6rem 0}figcaption{font-weight:600}
.plot{display:flex;gap:.4rem}.ends{display:flex;justify-content:space-between;margin-left:4.9rem}
.scale{display:flex;flex-direction:column;justify-content:space-between;width:4.5rem;text-align:right}
.scale,.ends{font-size:.75rem;color:var(--dim);font-variant-numeric:tabular-nums}
.residuals{display:block;flex:1;min-width:0;height:7rem;border:1px solid var(--line);border-radius:.3rem}
.residuals path{fill:none;stroke-width:3;stroke-linecap:round;vector-effect:non-scaling-stroke}
.residuals .axis{stroke:var(--line);stroke-width:1}.residuals .los{stroke:var(--path)}.residuals .nlos{stroke:var(--nlos)}
.lead{margin:.4rem 0;color:var(--dim)}
@media (max-width:40rem){main{padding:.6rem}body{font-size:15px}h1{margin:.3rem 0}h2{margin:1rem 0 .3rem}
.cards thead{display:none}.cards,.cards tbody,.cards tr,.cards td{display:block}
.cards tr{padding:.4rem 0;border-bottom:1px solid var(--line)}
.cards td,.cards td.words{display:flex;gap:.6rem;border:0;padding:.1rem 0;white-space:normal;min-width:0;overflow-wrap:anywhere}
.cards td::before{content:attr(data-name);color:var(--dim);flex:0 0 8rem}.cards td:empty{display:none}
.cards td:first-child{font-weight:600}.cards td:first-child::before{content:none}}
"""


def coloured(style: str) -> str:
    """Return a style with the palette's colours in place of their names, such as @path@ and @path-dark@."""
    names = {
        "path": canvas.PATH,
        "doubted": canvas.DOUBTED,
        "accepted": canvas.ACCEPTED,
        "rejected": canvas.REJECTED,
        "anchor": canvas.ANCHOR,
        "start": canvas.START,
        "nlos": canvas.NLOS,
        **{f"path{k}": c for k, c in enumerate(canvas.PATHS)},
    }
    for name, colour in names.items():
        style = style.replace(f"@{name}@", hexadecimal(colour)).replace(f"@{name}-dark@", hexadecimal(colour, dark=True))
    return style


STYLE = coloured(_STYLE)


SCRIPT = """
(function () {
  'use strict';
  document.querySelectorAll('[data-layer]').forEach(function (box) {
    box.addEventListener('change', function () {
      document.querySelectorAll('#map-view .' + box.dataset.layer).forEach(function (layer) {
        layer.classList.toggle('hidden', !box.checked);
      });
    });
  });
  var svg = document.getElementById('map-view'), all = svg.viewBox.baseVal;
  var whole = [all.x, all.y, all.width, all.height], pointers = new Map();
  function rescale() { svg.style.setProperty('--s', 1 / svg.getScreenCTM().a); }
  window.addEventListener('resize', rescale);
  rescale();
  function point(event) {
    return new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  }
  function zoom(at, factor) {
    var width = all.width * factor;
    if (width > whole[2] * 3 || width < whole[2] / 400) { return; }
    all.x = at.x - (at.x - all.x) * factor;
    all.y = at.y - (at.y - all.y) * factor;
    all.width = width;
    all.height *= factor;
    rescale();
  }
  function middle() { return {x: all.x + all.width / 2, y: all.y + all.height / 2}; }
  svg.addEventListener('wheel', function (event) {
    event.preventDefault();
    zoom(point(event), event.deltaY > 0 ? 1.2 : 1 / 1.2);
  }, {passive: false});
  svg.addEventListener('pointerdown', function (event) {
    svg.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
  });
  var place = document.getElementById('place');
  svg.addEventListener('pointermove', function (event) {
    var here = point(event);
    place.textContent = 'x ' + here.x.toFixed(2) + ' m, y ' + (-here.y).toFixed(2) + ' m';
    var before = pointers.get(event.pointerId);
    if (!before) { return; }
    if (pointers.size === 2) {
      var other = Array.from(pointers.values()).find(function (p) { return p.pointerId !== event.pointerId; });
      var was = Math.hypot(before.clientX - other.clientX, before.clientY - other.clientY);
      var is = Math.hypot(event.clientX - other.clientX, event.clientY - other.clientY);
      if (was > 0 && is > 0) { zoom(point(other), was / is); }
    } else {
      var a = point(before), b = point(event);
      all.x += a.x - b.x;
      all.y += a.y - b.y;
    }
    pointers.set(event.pointerId, event);
  });
  ['pointerup', 'pointercancel'].forEach(function (name) {
    svg.addEventListener(name, function (event) { pointers.delete(event.pointerId); });
  });
  document.getElementById('zoom-in').addEventListener('click', function () { zoom(middle(), 1 / 1.5); });
  document.getElementById('zoom-out').addEventListener('click', function () { zoom(middle(), 1.5); });
  document.getElementById('zoom-all').addEventListener('click', function () {
    all.x = whole[0]; all.y = whole[1]; all.width = whole[2]; all.height = whole[3];
    rescale();
  });
}());
"""
