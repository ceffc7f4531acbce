"""What to send to a Hokuyo, its geometry, and its readings in metres."""

import math
from dataclasses import dataclass

from ..errors import ProtocolError
from .scip import Reply
from .scip_codes import range_codes

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


def text_command(name: str) -> bytes:
    """Build a request without parameters.

    Parameters
    ----------
    name : one of VV PP II BM QT RS TM0 TM1 TM2 SCIP2.0.

    Returns
    -------
    bytes

    Raises
    ------
    ProtocolError : not one of these; other commands can hang a URG-04LX until its power is cycled.
    """
    if name not in {"VV", "PP", "II", "BM", "QT", "RS", "TM0", "TM1", "TM2", "SCIP2.0"}:
        raise ProtocolError(f"{name!r} is not a command that every unit has; use VV PP II BM QT RS TM0 TM1 TM2 SCIP2.0")
    return name.encode() + b"\n"


def rate_command(rate: int) -> bytes:
    """Build SS, which sets the speed of the RS-232 port.

    Parameters
    ----------
    rate : bit/s, of BAUD_RATES.

    Returns
    -------
    bytes

    Raises
    ------
    ProtocolError : not one of these.
    """
    if rate not in BAUD_RATES:
        raise ProtocolError(f"{rate} bit/s is no speed of its RS-232; use {', '.join(map(str, sorted(BAUD_RATES)))}")
    return f"SS{rate:06d}\n".encode()


def scan_command(
    start: int = 44, end: int = 725, *, cluster: int = 1, skip: int = 0, count: int | None = 0, wide: bool = True,
    geometry: Geometry | None = None,
) -> bytes:  # fmt: skip
    """Build GD/GS (one scan) or MD/MS (a stream).

    Parameters
    ----------
    start, end : first and last step.
    cluster : steps merged into one value, 0..99 (0 means 1).
    skip : scans left out between two that are sent, 0..9.
    count : scans to send, 0 = until QT; None = GD/GS, one scan now.
    wide : 3 characters a value (up to 5.6 m); False: 2 characters, up to 4.095 m.
    geometry : limits of the unit; default: of the URG-04LX.

    Returns
    -------
    bytes

    Raises
    ------
    ProtocolError : a step, cluster, skip or count that the unit would refuse.
    """
    unit = geometry or Geometry()
    if not unit.first <= start <= end <= unit.last:
        raise ProtocolError(f"steps {start}..{end} are not inside {unit.first}..{unit.last} of the {unit.model}")
    if not 0 <= cluster <= 99 or not 0 <= skip <= 9 or not 0 <= (count or 0) <= 99:
        raise ProtocolError(f"cluster {cluster} (0..99), skip {skip} (0..9) or count {count} (0..99) is out of range")
    letter = "D" if wide else "S"
    if count is None:
        return f"G{letter}{start:04d}{end:04d}{cluster:02d}\n".encode()
    return f"M{letter}{start:04d}{end:04d}{cluster:02d}{skip:01d}{count:02d}\n".encode()


def to_ranges(values: tuple[int, ...], geometry: Geometry, limit: int | None = None) -> tuple[float, ...]:
    """Convert raw values to metres with REP-117 codes.

    Parameters
    ----------
    values : mm or range_codes of the model.
    geometry : gives DMIN and DMAX.
    limit : mm, largest value that means something, where it is below DMAX (4095 with 2 characters).

    Returns
    -------
    tuple of float, m; +inf = nothing seen, nan = invalid.
    """
    low, high = geometry.distance_min, min(geometry.distance_max, limit or geometry.distance_max)
    known = range_codes(geometry.model)
    codes = [known[v][0] if v in known else math.nan for v in range(low)]
    return tuple([codes[v] if v < low else v / 1000 if v < high else math.inf for v in values])


def parse_geometry(reply: Reply) -> Geometry:
    """Read the reply to PP.

    Parameters
    ----------
    reply : of PP.

    Returns
    -------
    Geometry

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
