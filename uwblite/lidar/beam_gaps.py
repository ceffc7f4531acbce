"""Surfaces between the beams of a coarse lidar: points on the chord of two beams that hit one straight surface.

With beams a degree apart, the hits on a wall are 0.1 m apart at 6 m already, and much farther at grazing incidence: too few for
a line, and too far apart for a nearest point. Where three neighbouring beams hit one line, this line is taken as the surface
between them as well; elsewhere the space between two beams is unknown.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..arrays import Bools, Floats, Ints
from ..odometry.attached import ScanPoints


@dataclass(frozen=True, slots=True)
class GapPolicy:
    """Gaps between beams that are filled."""

    spacing: ClassVar[float] = 0.1
    """Distance between points, m, that makes lines: a neighbourhood of 0.2 m holds four others."""
    coarse: ClassVar[float] = 0.0075
    """Angle between two beams, rad (0.43 degrees), from which on they are coarse. Finer beams that hit far apart graze a
    surface, whose shape between them is not measured; where they do not graze it they are dense enough."""
    widest: ClassVar[float] = 0.6
    """Wider gaps are not filled, m: they may contain niches and doors."""
    reach: ClassVar[float] = 15.0
    """Gaps farther away are not filled, m: the memory of the tables of nearest points grows with the square of a cloud's
    extent."""
    noise: ClassVar[float] = 0.04
    """Largest distance of the next hit from the line through two others, m."""
    bend: ClassVar[float] = 0.08
    """The same as a share of its distance along this line."""
    least_beside: ClassVar[float] = 0.4
    """Least ratio of neighbouring gaps on one line, at any grazing angle."""


def filled(rays: ScanPoints) -> ScanPoints:
    """Return the points of scans with further ones in the gaps between beams that hit one straight surface."""
    first = _on_one_line(rays)
    step = rays.points[first + 1] - rays.points[first]
    parts = np.ceil(np.hypot(step[:, 0], step[:, 1]) / GapPolicy.spacing).astype(np.intp)
    own = np.repeat(np.arange(len(first)), parts - 1)
    number = np.arange(len(own)) - np.repeat(np.cumsum(parts - 1) - (parts - 1), parts - 1) + 1
    share = (number / parts[own])[:, None]
    rows = np.concatenate([np.arange(len(rays.ray)), first[own]])
    order = np.argsort(rows, kind="stable")

    def column(values: Floats) -> Floats:
        between = values[first[own]] + share * (values[first[own] + 1] - values[first[own]])
        return np.concatenate([values, between])[order]

    rows = rows[order]
    return replace(rays.rows(rows), points=column(rays.points), origins=column(rays.origins))


def _on_one_line(rays: ScanPoints) -> Ints:
    """Return the hits behind which there is a gap to be filled: to the next beam's, on a line with the one before or behind."""
    step = np.diff(rays.points, axis=0, append=np.nan)
    gap = np.hypot(step[:, 0], step[:, 1])
    short = _beside(rays.scan, rays.ray) & (gap < GapPolicy.widest)
    wide = np.flatnonzero(short & (gap > GapPolicy.spacing))
    beam = rays.points[wide] - rays.origins[wide]
    reach = np.hypot(beam[:, 0], beam[:, 1])
    coarse = np.abs(step[wide, 0] * beam[:, 1] - step[wide, 1] * beam[:, 0]) > GapPolicy.coarse * reach * reach
    wide = wide[coarse & (reach < GapPolicy.reach)]
    # There is no gap behind the last hit and none before the first: the last one stands for it.
    before, after = (short[wide + k] & _continues(step[wide], step[wide + k]) for k in (-1, 1))
    return np.asarray(wide[before | after])


def _beside(scan: Ints, ray: Ints) -> Bools:
    """Return which hits (p,) are followed by a hit of the next beam."""
    return np.append((np.diff(scan) == 0) & (np.diff(ray) == 1), False)


def _continues(step: Floats, other: Floats) -> Bools:
    """Return which steps (p, 2) from hit to hit continue neighbouring ones (p, 2) in a straight line with similar lengths."""
    length = np.hypot(step[:, 0], step[:, 1])
    along = np.sum(step * other, axis=1) / length
    across = np.abs(step[:, 0] * other[:, 1] - step[:, 1] * other[:, 0]) / length
    return np.asarray((along > GapPolicy.least_beside * length) & (across < GapPolicy.noise + GapPolicy.bend * along))
