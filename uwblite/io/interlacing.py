"""Scanners that interlace: scans of one beam fewer whose beams lie between those of the others, in turn with them.

A log gives the number of readings alone. Whether the shorter scans begin half a beam later is shown by the scans themselves: on
surfaces that change with the angle, readings of following scans agree at one of the two offsets.
"""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Ints

_SMOOTH = 0.3
"""Difference of following readings, m, from which on they are of different surfaces."""


def beams_lie_between(longer: NDArray[np.floating], shorter: NDArray[np.floating], lines: tuple[Ints, Ints]) -> bool:
    """Return whether the beams of shorter scans (n, b) lie in the middle between those of longer ones (m, b + 1).

    An offset of s beams makes r(k + s) - r(k) = s dr/dk. Least squares would take noise for an offset of a half, so dr/dk is
    taken once from the two readings and once from those beside them (an instrumental variable). A robot that turns shifts the
    scans before and after in opposite senses.

    Parameters
    ----------
    longer, shorter : readings, m; nan = none. lines : (m,) and (n,) numbers of the scans in the log, increasing.
    """
    rows = _pairs_in_turn(*lines)
    # A scanner that interlaces alternates; one whose number of beams was changed does not.
    if 2 * len(rows[0]) < len(shorter):
        return False
    one, other = longer[rows[0]].astype(np.float64), shorter[rows[1]].astype(np.float64)
    between, around = one[:, 2:-1] - one[:, 1:-2], (one[:, 3:] - one[:, :-3]) / 3.0
    off = other[:, 1:-1] - one[:, 1:-2]
    with np.errstate(invalid="ignore"):
        used = (np.abs(between) < _SMOOTH) & (np.abs(around) < _SMOOTH) & (np.abs(off) < _SMOOTH)
    shift, whole = (float(np.sum((around * change)[used])) for change in (off, between))
    return shift > 0.25 * whole


def _pairs_in_turn(longer: Ints, shorter: Ints) -> tuple[Ints, Ints]:
    """Return the rows (p,), (p,) of longer and shorter scans that follow each other, in either order."""
    kind = np.repeat([0, 1], [len(longer), len(shorter)])
    row = np.concatenate([np.arange(len(longer)), np.arange(len(shorter))])
    order = np.argsort(np.concatenate([longer, shorter]), kind="stable")
    kind, row = kind[order], row[order]
    turns = np.flatnonzero(kind[1:] != kind[:-1])
    first, second = row[turns], row[turns + 1]
    begins = kind[turns] == 0
    return np.where(begins, first, second), np.where(begins, second, first)
