"""Words of the command line: numbers with unit and sigma, and options where the library names settings and arguments."""

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

from ..report.printable import sigma_text

if TYPE_CHECKING:
    from ..findings import Finding
    from ..map_result import AnchorEstimate, CalibrationEstimate


OPTIONS = {
    **{name: f"--{name}" for name in ("append", "crop", "force")},
    **{f"{unit}_unit": f"uwblite convert --{unit}-unit" for unit in ("range", "odometry", "laser", "time", "angle")},
    **{f"topics.{topic}": f"--{topic}-topic" for topic in ("odometry", "scan", "imu")},
    "to": "--to",
    "topics.base_frame": "--base-frame",
    "mappings": "--uwb-mapping",
    "mounting.laser_flipped": "--laser-flipped",
    "mounting.T_base_laser": "--laser-pose",
    "mounting.tag_position": "--tag",
    "mounting.anchor_height": "--anchor-height",
    "use_lidar=false": "--without lidar",
    "start": "uwblite convert run.log after.log --start",
    "end": "uwblite convert run.log before.log --end",
    "folder": "--out",
    "steps": "--lidar-steps",
    "shell": "--uwb shell:PORT",
}
"""What sets on the command line what a text of the library has in backticks, alone or with its value."""


def with_options(text: str) -> str:
    """Return a text of the library with options in place of the settings and arguments that it names."""
    return re.sub(r"`([\w.]+)(=[^`]*)?`", _option, text) if "`" in text else text


def _option(found: "re.Match[str]") -> str:
    name, value = found[1], found[2] or ""
    option = OPTIONS.get(name + value) or (OPTIONS[name] + value if name in OPTIONS else "")
    return f"`{option}`" if " " in option else option or found[0]


def findings_with_options(findings: "Iterable[Finding]") -> "tuple[Finding, ...]":
    """Return findings whose texts and cures name options."""
    return tuple(replace(f, text=with_options(f.text), cure=with_options(f.cure)) for f in findings)


def anchor_line(anchor: "AnchorEstimate") -> str:
    """Return one line about an anchor, such as

    ``anchor 5C0B: x 12.31 ±0.04 m, y -3.20 ±0.05 m, bias +0.46 ±0.02 m, 812 ranges, 6 % down-weighted (NLOS?)``.
    """
    x, y = (float(v) for v in anchor.position)
    if x != x or y != y:
        place = "no position"
    else:
        sigma_x, sigma_y = (max(float(anchor.covariance[k, k]), 0.0) ** 0.5 for k in (0, 1))
        place = f"x {signed(x)} \u00b1{sigma_text(sigma_x, 2)} m, y {signed(y)} \u00b1{sigma_text(sigma_y, 2)} m"
    parts = [f"anchor {anchor.id}: {place}"]
    if anchor.bias_sigma > 0:
        parts.append(f"bias {signed(anchor.bias, plus=True)} \u00b1{sigma_text(anchor.bias_sigma, 2)} m")
    parts.append(f"{anchor.ranges} ranges")
    lost = 100 * (1 - anchor.used_share) if anchor.used_share == anchor.used_share else 0.0
    if lost >= 0.5:
        parts.append(f"{lost:.0f} % down-weighted (NLOS?)")
    if anchor.status != "ok":
        parts.append(f"{anchor.status.upper()}: {anchor.reason}" if anchor.reason else anchor.status.upper())
    if anchor.alternative is not None:
        parts.append(f"or at x {signed(float(anchor.alternative[0]))} m, y {signed(float(anchor.alternative[1]))} m")
    return ", ".join(parts)


def calibration_line(value: "CalibrationEstimate") -> str:
    """Return one line about a calibration value; ratios in per cent."""
    return calibration_text(value.name, value.value, value.sigma, value.unit, value.meaning)


def calibration_text(name: str, value: float, sigma: float, unit: str, meaning: str) -> str:
    """Return the same of its fields."""
    value, sigma, unit, digits = (100 * value, 100 * sigma, "%", 2) if unit == "1" else (value, sigma, unit, 3)
    digits = 4 if unit.startswith("rad") else digits
    return f"{meaning}: {signed(value, digits, plus=True)} \u00b1{sigma_text(sigma, digits)} {unit} ({name})"


def signed(value: float, digits: int = 2, *, plus: bool = False) -> str:
    """Return a number; what rounds to zero has no minus sign."""
    return f"{round(value, digits) + 0.0:{'+' if plus else ''}.{digits}f}"
