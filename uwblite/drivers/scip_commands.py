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
        return 2 * math.pi / self.resolution

    @property
    def step_time(self) -> float:
        return 60.0 / self.speed / self.resolution

    @property
    def period(self) -> float:
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
    """Return raw values, mm, in m; +inf = nothing seen, nan = invalid (REP-117).

    Below DMIN values are codes of the model; 2 characters hold at most `limit`, mm.
    """
    low, high = geometry.distance_min, min(geometry.distance_max, limit or geometry.distance_max)
    nothing = NOTHING_SEEN.get(geometry.model[:3], ())
    codes = [math.inf if v in nothing else math.nan for v in range(low)]
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
    unit = Geometry(fields.get("MODL", "unknown").partition("(")[0], *numbers.values())
    sane = 0 <= unit.distance_min < unit.distance_max and unit.resolution > 0 and unit.speed > 0
    if not (sane and 0 <= unit.first < unit.last <= unit.resolution + unit.front):
        raise ProtocolError(f"PP: absurd geometry {unit}")
    return unit


NOTHING_SEEN = {"URG": (0, 6), "UBG": (0, 6), "UHG": (0, 6), "UTM": (1,)}
"""Values below DMIN that say that nothing reflects within range, by the first letters of the model: no echo; of a UTM no object
(table 4 of the specification). All others are errors, as low intensity, readings that disagree, a strong reflector; of a model
that is not known too, so that nothing is taken for free space."""

_MEANINGS = {
    "01": "a bad first step, or a code of the time-adjust mode",
    "04": "the last step is out of range",
    "10": "the laser is off",
    "98": "resumed after a pause",
    "0E": "undefined command",
    "0F": "undefined command",
    "0I": "in firmware-update mode",
    "0L": "abnormal state",
    "0M": "unstable",
}
"""Of statuses that a unit may answer to what is sent here; all are in the specification."""
_PAUSES, _FAULTS, _RESUMED = range(21, 50), range(50, 98), 98
_GOOD = {("TM", "02"), ("TM", "03"), ("SS", "03")}
"""Refusals that say that it is so already."""


def status_meaning(command: str, status: str) -> tuple[str, str]:
    """Return the kind of a status that came with a command, and what it means.

    Kinds are "ok", "paused", "resumed", "hardware-fault", "refused" and "scip1".
    """
    if len(status) == 1:
        return ("ok", "SCIP 1.1: ok") if status == "0" else ("scip1", "the unit has SCIP 1.1; send SCIP2.0")
    text = f"status {status}: {_MEANINGS.get(status, 'see the specification of SCIP 2.0')}"
    if command[:1] in "GM" and status.isdigit():
        if int(status) in _PAUSES:
            return "paused", f"status {status}: the unit paused to verify itself and comes back by itself"
        if int(status) in _FAULTS:
            return "hardware-fault", f"status {status}: hardware fault (laser, motor or the like)"
        if int(status) == _RESUMED:
            return "resumed", text
    return "ok" if status in ("00", "99") or (command[:2], status) in _GOOD else "refused", text
