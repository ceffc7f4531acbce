"""Text as a terminal, a page and a table may have it: from files, numbers with unit and sigma, lines about estimates."""

import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..map_result import AnchorEstimate, CalibrationEstimate


def printable(text: str) -> str:
    """Return text on one line without anything that a terminal would obey, written as escapes instead.

    Control characters, line ends, marks that turn the direction of writing, and bytes of file names that are not UTF-8.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else _escape(c) for c in text)


def encodable(text: str) -> str:
    """Return text that UTF-8 can hold: bytes of file names that are not UTF-8 written as escapes."""
    return text if text.isascii() else re.sub("[\ud800-\udfff]", lambda match: _escape(match[0]), text)


def csv_field(text: str) -> str:
    """Return text as a field of a CSV file."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:
        # So Python keeps the byte of a name that is not UTF-8.
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape", "surrogatepass").decode()


def duration(seconds: float) -> str:
    """Return a time span in words, such as 3.2 s, 4 min 05 s or 1 h 02 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def sigma_text(sigma: float, digits: int) -> str:
    """Return a standard deviation with so many decimals, or more where it would show less than two digits of itself.

    What is not finite is "?", and 0 is "0": it was given, not estimated.
    """
    if not math.isfinite(sigma):
        return "?"
    if sigma <= 0.0:
        return "0"
    return f"{sigma:.{max(digits, min(1 - math.floor(math.log10(sigma)), _MOST_DIGITS))}f}"


_MOST_DIGITS = 9


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
