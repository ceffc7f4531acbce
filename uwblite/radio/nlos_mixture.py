"""Model of one anchor's range errors: a core in line of sight, a tail of NLOS delays, and gross errors.

A range that goes around or through an obstacle is too long, never too short. So errors are a mixture of a normal core, the same
core lengthened by an exponentially distributed detour, and a uniform rest (reflections, false detections)::

    f(e) = (1 - p - u) N(e; c, s) + p EMG(e; c, s, t) + u / W

All parameters come from the errors themselves by expectation maximisation (A. Dempster, N. Laird, D. Rubin 1977). The
weights that then make least squares the maximum-likelihood estimate of the place of the mode m are s^2 psi(e) / (e - m)
with psi = -f' / f: positive errors get less weight than negative ones of the same size.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import erfcx

from ..arrays import MAD_TO_SIGMA, TINY, Floats

_TAIL, _DETOUR, _WILD = 0.2, 0.5, 0.05
"""Usual share of ranges with a detour, mean detour, m, and share of gross errors."""
_LEAST_WILD, _WIDTH = 1e-3, 2.0
"""Share of gross errors that no number of ranges without one excludes; least width of their distribution, m."""
_SHORTEST = 2.0
"""Least mean detour, in standard deviations of the core; a shorter one is no tail but a part of the core."""
_CLEAN = 15.0
"""Prior number of ranges in the core: a few ranges alone determine neither tail nor gross errors."""
_ROUNDS, _STILL = 60, 1e-4
"""Most rounds of a fit, and the move of the core, in its standard deviations, that ends it."""
_PARTS = 256
"""Parts into which the interval with the mode is cut, three times: the last one is below a ten millionth of the first."""
_NEVER = 1e-300
"""Density, 1/m, that is added where all parts underflow."""


@dataclass(frozen=True, slots=True)
class RangeMixture:
    """Distribution of one anchor's errors, measured minus expected."""

    centre: float
    """Mean of the core, m."""
    sigma: float
    """Standard deviation of the core, m."""
    tail: float
    """Share of ranges with a detour, 0..1."""
    detour: float
    """Mean detour, m."""
    wild: float
    """Share of gross errors, 0..1."""
    width: float
    """Width of the distribution of gross errors, m."""

    @staticmethod
    def usual(sigma: float, width: float) -> "RangeMixture":
        """Return the distribution before there are errors."""
        return RangeMixture(0.0, sigma, _TAIL, _DETOUR, _WILD, width)

    def density(self, errors: Floats) -> Floats:
        """Return the probability density (m,) of each error, 1/m."""
        normal, late, _ = _densities(errors - self.centre, self.sigma, self.detour)
        return (1.0 - self.tail - self.wild) * normal + self.tail * late + self.wild / self.width + _NEVER

    def core(self, errors: Floats) -> Floats:
        """Return the probability (m,) of each error to be of the core."""
        normal, _, _ = _densities(errors - self.centre, self.sigma, self.detour)
        return (1.0 - self.tail - self.wild) * normal / self.density(errors)

    def log_density(self, errors: Floats) -> Floats:
        """Return the logarithm of the probability density (m,) of each error, 1/m; some share of gross errors is certain."""
        return np.log(replace(self, wild=max(self.wild, _LEAST_WILD)).density(errors))

    def mode(self) -> float:
        """Return the likeliest error, m."""
        low, high = 0.0, 3.0 * self.sigma
        for _ in range(3):
            at = np.linspace(low, high, _PARTS + 1)
            first = int(np.argmax(np.append(self._score(at[1:-1]) > 0.0, True)))
            low, high = float(at[first]), float(at[first + 1])
        return self.centre + low

    def weights(self, errors: Floats, mode: float | None = None) -> Floats:
        """Return the weights (m,), 0..1, of squared errors about the mode that make them a maximum-likelihood estimate."""
        off, mode = errors - self.centre, (self.mode() if mode is None else mode) - self.centre
        step = 10.0 * _STILL * self.sigma
        away = np.where(np.abs(off - mode) < step, mode + step, off)
        return np.clip(self.sigma**2 * self._score(away) / (away - mode), 0.0, 1.0)

    def _score(self, off: Floats) -> Floats:
        """Return -f' / f at errors (m,) from the core's mean."""
        normal, late, _ = _densities(off, self.sigma, self.detour)
        core = (1.0 - self.tail - self.wild) * normal
        slope = core * off / self.sigma**2 + self.tail / self.detour * (late - normal)
        return slope / (core + self.tail * late + self.wild / self.width + _NEVER)


def fit(errors: Floats, least_sigma: float, most_sigma: float = np.inf) -> RangeMixture:
    """Fit the mixture to errors.

    Parameters
    ----------
    errors : (m,) measured minus expected, m; m >= 1.
    least_sigma, most_sigma : the core is not narrower, and not wider, m.
    """
    centre, sigma = shortest_half(errors)
    sigma = min(max(sigma, least_sigma), most_sigma)
    width = max(float(np.ptp(errors)), _WIDTH)
    tail, detour, wild = _TAIL, 2.0 * _SHORTEST * sigma, _WILD
    for _ in range(_ROUNDS):
        off = errors - centre
        normal, late, expected = _densities(off, sigma, detour)
        core, slow, rest = (1.0 - tail - wild) * normal, tail * late, wild / width
        each = 1.0 / (core + slow + (rest + _NEVER))
        core, slow = core * each, slow * each
        of_core, of_tail, gross = float(core.sum()), float(slow.sum()), rest * float(each.sum())
        total = of_core + of_tail + gross + _CLEAN
        tail, wild = of_tail / total, gross / total
        of_core, of_tail = max(of_core, TINY), max(of_tail, TINY)
        detour = max(float(slow @ expected) / of_tail, _SHORTEST * sigma)
        moved = float(core @ off) / of_core
        centre += moved
        sigma = min(max(math.sqrt(float(core @ (errors - centre) ** 2) / of_core), least_sigma), most_sigma)
        if abs(moved) < _STILL * sigma:
            break
    return RangeMixture(centre, sigma, tail, detour, wild, width)


def shortest_half(values: Floats) -> tuple[float, float]:
    """Return middle and normal-equivalent standard deviation of the shortest interval with half of the values (m,)."""
    order = np.sort(values)
    inside = max(int(np.ceil(0.5 * len(order))), 1)
    spans = order[inside - 1 :] - order[: len(order) - inside + 1]
    first = int(np.argmin(spans))
    return float(order[first : first + inside].mean()), 0.5 * MAD_TO_SIGMA * float(spans[first])


def _densities(off: Floats, sigma: float, detour: float) -> tuple[Floats, Floats, Floats]:
    """Return the densities (m,) of the core and of core plus detour at errors from the core's mean, and the expected detour.

    A detour, given the error, is normal about off - sigma^2 / detour =: sigma a and cut off at 0: its mean is
    sigma (a + phi(a) / Phi(a)). Phi(a) exp(a^2 / 2) = erfcx(-a / sqrt(2)) / 2 neither loses digits nor overflows below _SURE;
    above it, Phi(a) is 1.
    """
    z, ratio = off / sigma, sigma / detour
    a = z - ratio
    scaled = erfcx(np.minimum(a, _SURE) * -np.sqrt(0.5))
    bell = np.exp(-0.5 * z * z)
    late, hazard = bell * scaled, np.sqrt(2.0 / np.pi) / scaled
    if (sure := a > _SURE).any():
        late = np.where(sure, 2.0 * np.exp(np.minimum(ratio * (0.5 * ratio - z), 0.0)), late)
    mean = np.maximum(sigma * (a + hazard), 0.0)
    return bell / (sigma * np.sqrt(2.0 * np.pi)), late / (2.0 * detour), mean


_SURE = 20.0
"""Standard deviations by which an error is longer than the core allows from which on it certainly has a detour."""
