"""Text from files and file names as a terminal, a page and a table may have it."""

import math
import re


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
