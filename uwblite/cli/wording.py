"""Numbers in words, always with unit and sigma."""

from typing import TYPE_CHECKING

from ..report.printable import sigma_text

if TYPE_CHECKING:
    from ..map_result import AnchorEstimate, CalibrationEstimate


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
