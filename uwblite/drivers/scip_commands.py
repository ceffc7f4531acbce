"""What to send to a Hokuyo, its geometry, its readings in metres, and what its codes mean. From C-42-03320B and drivers."""

import math
from dataclasses import dataclass

from ..errors import ProtocolError
from .scip import Reply

BAUD_RATES = (115200, 19200, 57600, 250000, 500000, 750000)
"""bit/s of the RS-232 port, in the order tried; on USB the rate means nothing."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """The answer of the unit to PP; defaults are those of the URG-04LX."""

    model: str = "URG-04LX"
    distance_min: int = 20
    distance_max: int = 5600
    """mm."""
    resolution: int = 1024
    """Steps in a full turn."""
    first: int = 44
    last: int = 725
    front: int = 384
    """Steps; `front` looks along the laser's x axis."""
    speed: int = 600
    """rev/min."""

    @property
    def step_angle(self) -> float:
        """Angle between steps, rad."""
        return 2 * math.pi / self.resolution

    @property
    def step_time(self) -> float:
        """Time between steps, s."""
        return 60.0 / self.speed / self.resolution

    @property
    def period(self) -> float:
        """Time of a turn, s."""
        return 60.0 / self.speed


@dataclass(frozen=True, slots=True)
class ScanRequest:
    """Which scans a unit is asked for."""

    start: int | None = None
    end: int | None = None
    """First and last step; None = the unit's own limits."""
    cluster: int = 1
    """Steps merged into one value, 1..99."""
    skip: int = 0
    """Scans left out between two that are sent, 0..9."""
    wide: bool = True
    """Three characters a value (up to 5.6 m); False: two, up to 4.095 m, for slow RS-232."""

    def command(self, unit: Geometry) -> bytes:
        """Return MD or MS, which streams until QT.

        Raises
        ------
        ProtocolError : a step, cluster or skip that the unit would refuse.
        """
        start = unit.first if self.start is None else self.start
        end = unit.last if self.end is None else self.end
        if not unit.first <= start <= end <= unit.last:
            raise ProtocolError(f"steps {start}..{end} are not inside {unit.first}..{unit.last} of the {unit.model}")
        if not 1 <= self.cluster <= 99 or not 0 <= self.skip <= 9:
            raise ProtocolError(f"cluster {self.cluster} (1..99) or skip {self.skip} (0..9) is out of range")
        return f"M{'D' if self.wide else 'S'}{start:04d}{end:04d}{self.cluster:02d}{self.skip:01d}00\n".encode()


def to_ranges(values: tuple[int, ...], geometry: Geometry, limit: int | None = None) -> tuple[float, ...]:
    """Return raw values in m; +inf = nothing seen, nan = invalid (REP-117).

    Parameters
    ----------
    values : mm or range_codes of the model.
    geometry : gives DMIN and DMAX.
    limit : mm, largest value that means something, where it is below DMAX (4095 with 2 characters).
    """
    low, high = geometry.distance_min, min(geometry.distance_max, limit or geometry.distance_max)
    known = range_codes(geometry.model)
    codes = [known[v][0] if v in known else math.nan for v in range(low)]
    return tuple([codes[v] if v < low else v / 1000 if v < high else math.inf for v in values])


def parse_geometry(reply: Reply) -> Geometry:
    """Read the reply to PP.

    Raises
    ------
    ProtocolError : a field is missing or absurd.
    """
    fields = reply.fields()
    try:
        numbers = {key: int(fields[key]) for key in ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")}
    except (KeyError, ValueError) as error:
        raise ProtocolError(f"PP: field missing or not a number ({error})") from None
    unit = Geometry(
        fields.get("MODL", "unknown").partition("(")[0], numbers["DMIN"], numbers["DMAX"], numbers["ARES"],
        numbers["AMIN"], numbers["AMAX"], numbers["AFRT"], numbers["SCAN"],
    )  # fmt: skip
    sane = 0 <= unit.distance_min < unit.distance_max and unit.resolution > 0 and unit.speed > 0
    if not (sane and 0 <= unit.first < unit.last <= unit.resolution + unit.front):
        raise ProtocolError(f"PP: absurd geometry {unit}")
    return unit


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
