"""What the numbers of SCIP 2.0 mean: range values that are no distances, and status codes. From C-42-03320B and drivers."""

import math

INF, NAN = math.inf, math.nan

RANGE_CODES: dict[int, tuple[float, str]] = {
    0: (INF, "no echo: nothing within range, or too dark to see"),
    1: (NAN, "low intensity"),
    2: (NAN, "low intensity"),
    3: (NAN, "measurement error"),
    4: (NAN, "measurement error"),
    5: (NAN, "measurement error"),
    6: (INF, "no valid echo; older manuals: possibly beyond 5.7 m"),
    7: (NAN, "too near, or contradicted by its neighbours"),
    8: (NAN, "the two modulation waves disagree in intensity"),
    9: (NAN, "same step failed in the last two scans"),
    **dict.fromkeys(range(10, 18), (NAN, "measurement error")),
    18: (NAN, "strong reflector"),
    19: (NAN, "step cannot be measured"),
}
"""Meaning of range values below DMIN, as REP-117 wants them: +inf = looked and saw nothing, nan = do not use."""

UTM_CODES: dict[int, tuple[float, str]] = {
    1: (INF, "no object in the range"),
    2: (NAN, "too near"),
    3: (NAN, "measurement error, perhaps interference"),
    4: (NAN, "out of range at the near end"),
    5: (NAN, "other errors"),
}
"""The same of the UTM-30LX (table 4 of the specification)."""
OTHER_CODES: dict[int, tuple[float, str]] = {}
"""Of a model whose codes are not known: nothing is taken for free space."""


def range_codes(model: str) -> dict[int, tuple[float, str]]:
    """Return the meaning of values below DMIN for a model as PP names it."""
    families = {"URG": RANGE_CODES, "UBG": RANGE_CODES, "UHG": RANGE_CODES, "UTM": UTM_CODES}
    return families.get(model[:3], OTHER_CODES)


STATUS_BY_COMMAND: dict[str, dict[str, str]] = {
    "BM": {"00": "laser on", "01": "laser malfunction", "02": "laser is on already"},
    "QT": {"00": "laser off, stream stopped"},
    "RS": {"00": "reset"},
    "TM": {"00": "ok", "01": "bad code", "02": "in time-adjust mode already", "03": "left time-adjust mode already",
           "04": "not in time-adjust mode"},
    "SS": {"00": "ok", "01": "not a number", "02": "no such bit rate", "03": "that rate is set already",
           "04": "rate not possible"},
    "CR": {"00": "ok", "01": "not a number", "02": "no such speed", "03": "that speed is set already",
           "04": "speed not possible"},
}  # fmt: skip
STATUS_OF_SCANS = {
    "00": "ok", "01": "start step is not a number", "02": "end step is not a number", "03": "cluster is not a number",
    "04": "end step out of range", "05": "end step is before the start step", "06": "skip is not a number",
    "07": "count is not a number", "10": "laser is off", "98": "resumed after a pause", "99": "data follow",
}  # fmt: skip
STATUS_OF_ALL = {
    "0A": "cannot create the transmission", "0B": "buffer short, or the command was repeated in one batch",
    "0C": "too few parameters", "0D": "too few parameters", "0E": "undefined command", "0F": "undefined command",
    "0G": "string too long", "0H": "string has bad characters", "0I": "in firmware-update mode",
    "0L": "abnormal state", "0M": "unstable",
}  # fmt: skip


def status_meaning(command: str, status: str) -> tuple[str, str]:
    """Name a status code.

    Parameters
    ----------
    command : the echo it came with.
    status : two characters.

    Returns
    -------
    kind : "ok", "paused", "resumed", "hardware-fault", "refused" or "scip1".
    text : what it means.
    """
    if len(status) == 1:
        return ("ok", "SCIP 1.1: ok") if status == "0" else ("scip1", "the unit has SCIP 1.1; send SCIP2.0")
    known = STATUS_BY_COMMAND.get(command[:2], STATUS_OF_SCANS if command[:1] in "GM" else {})
    text = known.get(status) or STATUS_OF_ALL.get(status)
    if command[:1] in "GM" and status.isdigit():
        number = int(status)
        if 21 <= number <= 49:
            return "paused", f"status {status}: the unit paused to verify itself and comes back by itself"
        if 50 <= number <= 97:
            return "hardware-fault", f"status {status}: hardware fault (laser, motor or the like)"
        if number == 98:
            return "resumed", f"status {status}: {text}"
    good = status in ("00", "99") or (command[:2], status) in {("BM", "02"), ("TM", "02"), ("TM", "03"), ("SS", "03")}
    return "ok" if good else "refused", f"status {status}: {text or 'not in the manual'}"
