"""Text as a terminal, a page and a table may have it: from files, numbers with unit and sigma, lines about estimates."""

import math
import re
from collections.abc import Callable
from html import escape as escape_markup
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..map_result import AnchorEstimate

_MOST_DIGITS = 9
DECIMALS = 3
"""Of lengths and times whose sigma says how many of them mean something."""
_PERCENT = 100
_SIXTY = 60
"""Seconds of a minute, minutes of an hour."""
_WORTH_SAYING = 0.005
"""Share of an anchor's ranges that do not agree with the map."""


def printable(text: str) -> str:
    """Return text on one line without anything that a terminal would obey, written as escapes instead.

    Control characters, line ends, marks that turn the direction of writing, and bytes of file names that are not UTF-8.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else _code(c) for c in text)


def escape(text: str) -> str:
    """Return text for a page, without markup and without what cannot be printed."""
    return escape_markup(printable(text))


def encodable(text: str) -> str:
    """Return text that UTF-8 can hold: bytes of file names that are not UTF-8 written as escapes."""
    return text if text.isascii() else re.sub("[\ud800-\udfff]", lambda match: _code(match[0]), text)


def json_ready(value: Any, number: Callable[[float], float] = float, text: Callable[[str], str] = str) -> Any:
    """Return a value as JSON has it: arrays as lists, numbers that are not finite as None.

    Parameters
    ----------
    number, text : what becomes of other numbers with decimals, and of texts before they are made to be UTF-8.
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {encodable(str(k)): json_ready(v, number, text) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(v, number, text) for v in value]
    if isinstance(value, str):
        return encodable(text(value))
    if isinstance(value, float):
        return number(value) if math.isfinite(value) else None
    return value


def csv_field(text: str) -> str:
    """Return text as a field of a CSV file."""
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in '",\r\n') else text


def _code(character: str) -> str:
    if "\udc80" <= character <= "\udcff":
        # So Python keeps the byte of a name that is not UTF-8.
        return f"\\x{character.encode(errors='surrogateescape').hex()}"
    return character.encode("unicode_escape", "surrogatepass").decode()


def duration(seconds: float) -> str:
    """Return a time span in words, such as 3.2 s, 4 min 05 s or 1 h 02 min."""
    if round(seconds, 1) < _SIXTY:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), _SIXTY)
    hours, left = divmod(minutes, _SIXTY)
    return f"{hours} h {left:02d} min" if hours else f"{minutes} min {rest:02d} s"


def percent(share: float) -> str:
    """Return a share in whole per cent, such as 6 %."""
    return f"{_PERCENT * share:.0f} %"


def sigma_text(sigma: float, digits: int) -> str:
    """Return a standard deviation with so many decimals, or more where it would show less than two digits of itself.

    What is not finite is "?", and 0 is "0": it was given, not estimated.
    """
    if not math.isfinite(sigma):
        return "?"
    return f"{sigma:.{max(digits, min(1 - math.floor(math.log10(sigma)), _MOST_DIGITS))}f}" if sigma > 0.0 else "0"


def anchor_line(anchor: "AnchorEstimate") -> str:
    """Return one line about an anchor, such as

    ``anchor 5C0B: x 12.31 ±0.04 m, y -3.20 ±0.05 m, bias +0.46 ±0.02 m, 812 ranges, 6 % down-weighted (NLOS?)``.
    """
    (x, y), (sigma_x, sigma_y) = anchor.position.tolist(), sigmas(anchor)
    place = f"x {signed(x)} \u00b1{sigma_text(sigma_x, 2)} m, y {signed(y)} \u00b1{sigma_text(sigma_y, 2)} m"
    parts = [f"anchor {anchor.id}: {place if math.isfinite(x + y) else 'no position'}"]
    if anchor.bias_sigma > 0:
        parts.append(f"bias {signed(anchor.bias, plus=True)} \u00b1{sigma_text(anchor.bias_sigma, 2)} m")
    parts.append(f"{anchor.ranges} ranges")
    if 1.0 - anchor.used_share >= _WORTH_SAYING:
        parts.append(f"{percent(1.0 - anchor.used_share)} down-weighted (NLOS?)")
    if anchor.status != "ok":
        parts.append(f"{anchor.status.upper()}: {anchor.reason}" if anchor.reason else anchor.status.upper())
    if anchor.alternative is not None:
        x, y = anchor.alternative.tolist()
        parts.append(f"or at x {signed(x)} m, y {signed(y)} m")
    return ", ".join(parts)


def sigmas(anchor: "AnchorEstimate") -> tuple[float, float]:
    """Return the standard deviations of an anchor along x and y, m."""
    x, y = (max(variance, 0.0) ** 0.5 for variance in anchor.covariance.diagonal().tolist())
    return x, y


def calibration_text(name: str, value: float, sigma: float, unit: str, meaning: str) -> str:
    """Return one line about a calibration value; ratios in per cent."""
    value, sigma, unit, digits = readable(value, sigma, unit)
    return f"{meaning}: {signed(value, digits, plus=True)} \u00b1{sigma_text(sigma, digits)} {unit} ({name})"


def readable(value: float, sigma: float, unit: str) -> tuple[float, float, str, int]:
    """Return a calibration value, its standard deviation and unit, ratios in per cent, and how many decimals are shown."""
    if unit == "1":
        return _PERCENT * value, _PERCENT * sigma, "%", 2
    return value, sigma, unit, DECIMALS + 1 if unit.startswith("rad") else DECIMALS


def signed(value: float, digits: int = 2, *, plus: bool = False) -> str:
    """Return a number; what rounds to zero has no minus sign."""
    return f"{round(value, digits) + 0.0:{'+' if plus else ''}.{digits}f}"
