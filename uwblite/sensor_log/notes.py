"""What reader and screening saw in a recording besides its measurements."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..arrays import Floats
from ..findings import Fact


@dataclass(frozen=True, slots=True, eq=False)
class LogNotes:
    """What the reader saw besides the data: counts that must not vanish silently."""

    source: str = ""
    """Name of the file(s), as given."""
    sha256: str = ""
    """Hash of the bytes read."""
    lines: int = 0
    broken_lines: tuple[tuple[int, str], ...] = ()
    """First broken lines as (line number, why); `broken` counts all."""
    broken: int = 0
    skipped: dict[str, int] = field(default_factory=dict)
    """Messages that are known and not used, by name."""
    warnings: tuple[str, ...] = ()
    """Oddities in words, each with its remedy or what was done."""
    unread: tuple[str, ...] = ()
    """Topics of a bag that may hold ranges and were not read."""
    set_back: dict[str, float] = field(default_factory=dict)
    """By how much a sensor's clock was set back at most, s, in the order in which its messages were written."""
    one_clock: bool = False
    """Whether odometry and scans cannot be of different clocks: they share messages, or their stamps are made up."""
    scans_left_out: int = 0
    """Scans that were recorded and are not among `scans`, because no map looks at them."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryBreaks:
    """Steps of the odometry that were predicted, not measured."""

    stamps: Floats
    """(b,) of the reading before the step, s."""
    sigma: Floats
    """(b, 3) standard deviation of the step, m, m, rad; what wheels are uncertain by besides comes on top."""

    @staticmethod
    def none() -> "OdometryBreaks":
        """Return no breaks."""
        return OdometryBreaks(np.zeros(0), np.zeros((0, 3)))

    @staticmethod
    def of_all(parts: "Sequence[OdometryBreaks]") -> "OdometryBreaks":
        """Return the breaks of one or more parts, in the order of time."""
        stamps, sigma = np.concatenate([b.stamps for b in parts]), np.concatenate([b.sigma for b in parts])
        order = np.argsort(stamps, kind="stable")
        return OdometryBreaks(stamps[order], sigma[order])


@dataclass(frozen=True, slots=True, eq=False)
class Screening:
    """What was found and repaired in a recording before it is mapped."""

    facts: tuple[Fact, ...]
    """Of each of them a rule makes a finding."""
    breaks: OdometryBreaks
    lidar_by_wheels: float = float("nan")
    """Distance by the lidar / distance by the wheels; nan where nothing shows it."""
    turn_ratio: tuple[float, float] = (float("nan"), float("nan"))
    """Turn by the lidar / turn by the wheels, and its standard deviation; nan where nothing shows it."""
    in_bursts: tuple[str, ...] = ()
    """Sensors whose stamps are times of receipt in bursts: no clock offset can be estimated against them."""
