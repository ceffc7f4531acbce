"""The factor between motions that wheels and lidar measure."""

import numpy as np

from ..arrays import Floats, Ints

_LEAST = 12
"""Clear motions whose median is a factor."""


def ratios(wheels: Floats, lidar: Floats, clear: float) -> tuple[Ints, Floats]:
    """Return the pairs whose motion by the wheels (e, d) is clear, and the ratio of the lidar's motion to it, along it."""
    size = np.sqrt(np.sum(wheels**2, axis=1))
    rows = np.flatnonzero(size > clear)
    return rows, np.sum(wheels * lidar, axis=1)[rows] / size[rows] ** 2


def factor(wheels: Floats, lidar: Floats, clear: float, otherwise: float = 1.0) -> float:
    """Return the factor of the wheels' motions (e, d) that most agree on; `otherwise` where there are too few."""
    ratio = ratios(wheels, lidar, clear)[1]
    return float(np.median(ratio)) if len(ratio) >= _LEAST else otherwise


def undiluted(wheels: Floats, lidar: Floats, clear: float, otherwise: float) -> float:
    """Return the factor of the wheels' motions (e, d) to the lidar's; `otherwise` where there are too few clear ones.

    Noise of one sensor, such as rounding, draws the ratio to its own motions down (regression dilution). So the ratio to the
    other's motions is taken as well, and of both the one that is nearer to 1.
    """
    nan = float("nan")
    ratio, inverse = factor(wheels, lidar, clear, nan), factor(lidar, wheels, clear, nan)
    if not (ratio > 0.0 and inverse > 0.0):
        return otherwise if np.isnan(ratio) else ratio
    return min(ratio, 1.0 / inverse, key=lambda value: abs(np.log(value)))
