"""The true cause of each planted fault: the kinds of findings, or words of a refusal, that name it."""

import ast
from functools import cache
from pathlib import Path

WHEELS = (
    "wheels-stand-still", "wheels-against-lidar", "odometry-slips", "odometry-unit", "drift",
    "turn-scale", "heading-against-path", "mirrored", "odometry-breaks", "odometry-glitches",
    "unusual-calibration", "scales", "laser-turned-over", "path-displaced", "wheels-against-ranges", "loose-links",
)  # fmt: skip
LIDAR = (
    "laser-turned-over", "laser-turned-away", "scans-do-not-match", "wheels-against-lidar", "free-space-violation",
    "repeated-scans", "repeated-readings", "own-body", "scales", "turn-scale", "loose-links", "untied-parts", "no-closure",
    "odometry-alone", "worse-than-parts", "path-displaced", "clock-offset",
)  # fmt: skip
RADIO = (
    "range-scatter", "ranges-disagree", "anchors-moved-together", "anchor-distrusted", "anchor-unplaced",
    "anchor-mirror-ambiguous", "moved-anchor", "repeated-ranges", "marked-ranges", "sustained-outliers",
    "drift", "no-anchor", "odometry-alone", "unusual-calibration", "scales", "exchanged-names",
    "antenna-delay",
)  # fmt: skip
CLOCKS = (
    "clock-set-back", "clock-jump", "stamps-in-bursts", "stamps-of-receipt", "made-up-stamps", "late-scans", "late-ranges",
    "clock-offset", "scan-duration",
    "ranges-outside-odometry", "scans-outside-odometry", "equal-stamps",
)  # fmt: skip
CUT = ("carried", "untied-parts", "loose-links", "odometry-gap", "odometry-breaks", "odometry-glitches", "no-closure")
GROUPS = {"wheels": WHEELS, "lidar": LIDAR, "radio": RADIO, "addresses": RADIO, "logs": CLOCKS + CUT}
"""By the module that plants the fault, what a fault of that sensor may be called."""

OWN = {
    "wheels frozen from half time": ("wheels-stand-still",), "wheels frozen for 20 s": ("wheels-stand-still",),
    "wheels frozen throughout": ("hardly-moving", "wheels-stand-still"), "no movement at all": ("hardly-moving",),
    "odometry in cm": ("centimetres",), "odometry in mm": ("millimetres",), "heading in degrees": ("degrees",),
    "laser in mm": ("millimetres",), "laser claims twice its view": ("field of view",), "ranges in mm": ("millimetres",),
    "ranges in feet": ("feet",), "ranges in yards": ("odometry-unit", "scales", "unusual-calibration"),
    "all stamps in minutes": ("minutes",), "laser: noise only": ("scans-do-not-match",),
    "laser mirrored": ("laser-turned-over",),
    "carried away, stamps closed up": (*CUT, "wheels-against-ranges"), "carried away, a gap of 40 s": CUT,
    "all anchors moved 2 m half-way": (*RADIO, "odometry-slips", "wheels-against-ranges"),
    "all anchors moved as one half-way": (*RADIO, "carried", "odometry-slips", "wheels-against-ranges"),
    "odometry absent for 40 %": CUT,
    "lidar absent for 40 %": CUT, "half of the scans an hour late": CLOCKS, "clock of the radio back 30 s": ("clock-set-back",),
    "clock of the lidar back 30 s": ("clock-set-back",), "clock of the odometry back 30 s": ("set back",),
    "clock of all back 30 s": ("set back",), "two robots in one log": ("two robots",),
    "two logs in one, overlapping by 25 s": ("two robots", "set back"), "two anchors with one name": ("anchor-distrusted",),
    "two buildings in one log": (*CUT, "free-space-violation"),
    "all ranges 2 m longer from half time": (*RADIO, "anchor-heights"),
    "the radio's clock runs 2 % fast": (*RADIO, "late-ranges"), "ranges 5 s late": CLOCKS, "ranges 18 s late": CLOCKS,
    "lidar 1 s late": (*CLOCKS, "wheels-against-lidar"), "odometry 1 s late": (*CLOCKS, "wheels-against-lidar"),
    "ranges beyond 5 m reported as 5 m": ("marked-ranges",), "half missing, stamps closed up, counted from zero": CUT,
    "the clock of all runs 1 % fast": CLOCKS, "nine of ten readings lost": (*RADIO, "uncertain", *CUT),
    "an anchor moved, one wheel slips": WHEELS + RADIO, "wheels frozen for 20 s, an anchor moved": ("wheels-stand-still",),
    "wheels frozen for 20 s, the lidar absent": ("wheels-stand-still", *CUT), "one wheel loose, the lidar absent": WHEELS + CUT,
    "the lidar knocked, an anchor moved": LIDAR + RADIO, "each half of the time has the scans of the other": (*LIDAR, *CLOCKS),
}  # fmt: skip
"""Rows whose cause has a name of its own."""


@cache
def _modules() -> dict[str, str]:
    """Return the module that plants each fault, from the table's own text."""
    tree = ast.parse((Path(__file__).parent / "every.py").read_text(encoding="utf-8"))
    (table,) = (node.value for node in ast.walk(tree) if isinstance(node, ast.AnnAssign) and isinstance(node.value, ast.Dict))
    found = {}
    for key, value in zip(table.keys, table.values, strict=True):
        names = [node.id for node in ast.walk(value) if isinstance(node, ast.Name) and node.id in GROUPS]
        found[ast.literal_eval(key)] = names[0] if names else ""
    return found


def causes_of(fault: str) -> tuple[str, ...]:
    """Return the kinds and words that name the true cause of a fault; none where there is no fault."""
    return OWN.get(fault) or GROUPS.get(_modules().get(fault, ""), ())
