"""Noise of single rays: from data sheets, and learnt from their residuals on known surfaces.

Residuals show two things. The first is the size of the noise. The second is the correlation of residuals in one place, since
walls are not straight, columns not round, and errors of neighbouring rays are correlated: the variance of the sum of n
residuals is then n times a factor, the design effect (L. Kish, Survey sampling, 1965), and n rays have the information of n
divided by that factor.
"""

from dataclasses import dataclass

import numpy as np

from ..arrays import Bools, Floats, Ints, spread

_NEAR, _SHARE = 0.01, 0.01
"""Standard deviation of a range by data sheets: 10 mm up to 1 m, and 1 % beyond (URG-04LX; other scanners are better)."""
_FEWEST = 200
"""Least number of rays from which their noise is learnt."""
_LEAST = 0.1
"""Least noise, as a share of that by data sheets."""
_CLIP = 3.0
"""Standard deviations at which residuals are clipped: outliers give no information about the noise of inliers."""
_MANY = 5
"""Least number of places of a surface from which the correlation of its residuals is learnt."""
_FITTED = np.array([2, 3])
"""Unknowns of a wall's line and a column's circle; fitting these reduces the sums of residuals."""
ALIKE = 4.0
"""Design effect until one is learnt (as of matches of clouds: RefinementConfig.correlation)."""


def range_sigma(reach: Floats) -> Floats:
    """Return the standard deviation, m, of ranges (n,), m, by data sheets."""
    return np.maximum(_NEAR, _SHARE * reach)


@dataclass(frozen=True, slots=True, eq=False)
class RayNoise:
    """Noise of rays as learnt from their residuals."""

    ratio: float
    """Of the noise to that of data sheets."""
    alike: Floats
    """(2,) design effect of rays on walls and on columns, 1 or more."""

    def weights(self, curved: bool, kernel: float) -> tuple[float, float]:
        """Return the information of a ray on a wall or a column relative to that by data sheets, and the inverse square of the
        width of a robust kernel, of so many standard deviations, on residuals by data sheets."""
        return 1.0 / (self.ratio**2 * float(self.alike[int(curved)])), 1.0 / (kernel * self.ratio) ** 2


UNLEARNT = RayNoise(1.0, np.full(2, ALIKE))


def learnt_noise(residual: Floats, place: Ints, surface: Ints, curved: Bools) -> RayNoise:
    """Learn the noise of rays from their residuals.

    Parameters
    ----------
    residual : (m,) in standard deviations by data sheets. place : (m,) number of the place of each ray on its surface.
    surface : (m,). curved : (s,) whether a surface is a column.
    """
    ratio = max(spread(residual), _LEAST) if len(residual) >= _FEWEST else 1.0
    clipped = np.where(np.abs(residual) < _CLIP * ratio, residual / ratio, 0.0)
    return RayNoise(ratio, _design_effects(clipped, place, surface, curved))


def _design_effects(residual: Floats, place: Ints, surface: Ints, curved: Bools) -> Floats:
    """Return the ratios (2,) of the squared sums of residuals over places to their sums of squares, of walls and of columns."""
    first = int(place.min(initial=0))
    many = int(place.max(initial=0)) - first + 1
    number = surface.astype(np.intp) * many + (place - first)
    shown = np.flatnonzero(np.bincount(number))
    sums, squares, of = np.bincount(number, residual)[shown], np.bincount(number, residual**2)[shown], shown // many
    places = np.bincount(of, minlength=len(curved))
    free = places - _FITTED[curved.astype(np.intp)]
    share = np.where(places >= _MANY, places / np.maximum(free, 1), 0.0)[of]
    found = np.full(2, ALIKE)
    for kind in range(2):
        own = (curved[of] == bool(kind)) & (share > 0.0)
        if own.any():
            found[kind] = max(1.0, float((share * sums**2)[own].sum() / max(squares[own].sum(), 1.0)))
    return found
