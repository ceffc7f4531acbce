"""Places in the map against one another: how well each explains what was measured during the last metres."""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from . import hypotheses, likelihood_field, range_likelihood, search, verdict
from .hypotheses import Hypotheses
from .known_map import KnownMap
from .sensing import TRACK_RAYS
from .walls import Rays
from .window import Ranges, Window

INDEPENDENT_RAYS = 15.0
"""Rays per metre of driving that count as independent when places are compared."""
LOOK_BACK = 4.0
"""m driven, of whose scans places are compared."""
_SEARCH_LOOKS = 2.5
"""m driven, of whose scans the search makes one cloud."""
_SIGMA_SCAN = (0.2, 0.2, 0.06)
"""m, m, rad; of a place that the search found by scans."""
_SIGMA_FLOOR = (0.1, 0.1, 0.03)
"""m, m, rad; drift within the window, on top of what ranges say of a place."""
_RADIO_REACH = 15.0
"""m beyond the outermost anchors; where a robot may be in a map without a grid."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Places in the map, and how well each explains what was measured."""

    bank: Hypotheses
    """The present hypotheses first."""
    complete: bool
    """No place that is as good was left out."""
    weight: Floats
    """(h,) log-likelihood."""
    fit: Floats
    """(h,) mean log-likelihood of the rays."""
    known: Floats
    """(h,) rays' ends in known space."""
    rays: Rays
    """Of the last metres, in the present frame of the base."""
    looks: int
    """Scans that they are of."""
    ranges: Ranges

    @property
    def hypotheses(self) -> Hypotheses:
        """All places, weighted by this alone."""
        return hypotheses.reweighted(Hypotheses(self.bank.mean, self.bank.covariance, np.zeros(len(self.bank))), self.weight)

    @property
    def elsewhere(self) -> bool:
        """Whether another place explains what was measured better than the first hypothesis."""
        return self.complete and bool(self.weight[1:].max(initial=-np.inf) > self.weight[0] + verdict.CERTAIN)


class PlaceSearch:
    """The whole map, ready to be searched, a little at a time."""

    def __init__(self, known: KnownMap) -> None:
        self.walls, self.anchors = known.walls, len(known.anchors.ids)
        self._field = None if known.walls is None else likelihood_field.field_of(known.walls)
        self._bounds = _bounds(known)
        self._odom = np.zeros(3)
        self._steps: search.Steps | None = None
        self._found: search.Places | None = None

    @property
    def idle(self) -> bool:
        """Whether no search is under way."""
        return self._steps is None and self._found is None

    def begin(self, window: Window, odom: Floats, way: float) -> None:
        """Begin to search the whole map for what a window holds.

        Parameters
        ----------
        odom : (3,) present pose in the odometry frame. way : the odometer now, m.
        """
        rays = window.seen(odom, way, _SEARCH_LOOKS)[0]
        self._odom = odom.copy()
        self._steps = search.places(self._field, rays, window.ranges_since(odom, way), self._bounds)

    def drop(self) -> None:
        """Leave a search that is under way."""
        self._steps = self._found = None

    def advance(self, odom: Floats) -> search.Places | None:
        """Do a unit of the work; return where the robot may be now, if the search had ended before.

        Parameters
        ----------
        odom : (3,) present pose in the odometry frame.
        """
        if self._found is not None:
            found, self._found = self._found, None
            return search.Places(se2.compose(found.poses, se2.between(self._odom, odom)), found.complete)
        try:
            if self._steps is not None:
                next(self._steps)
        except StopIteration as end:
            self._steps, self._found = None, end.value
        return None

    def compared(self, found: search.Places, bank: Hypotheses, window: Window, odom: Floats, way: float) -> Comparison:
        """Weight the places that a search found together with the present hypotheses by what a window holds."""
        ranges = window.ranges_since(odom, way)
        rays, ago = window.seen(odom, way, LOOK_BACK)
        recent = rays.rows(ago <= _SEARCH_LOOKS)
        before, bank = len(bank), hypotheses.joined(bank, self._started(found.poses, ranges, recent))
        weight = range_likelihood.range_likelihood(bank.poses, ranges)
        fit, known = np.zeros((2, len(bank)))
        if self.walls is not None and len(rays.hit):
            agreement = self.walls.agreement(bank.poses, rays)
            weight += INDEPENDENT_RAYS * (1.0 + float(ago.max())) * agreement.log_likelihood
            fit, known = agreement.log_likelihood, agreement.known
        new = _no_repetition(bank.poses, weight, before)
        looks = len(np.unique(ago))
        return Comparison(bank.rows(new), found.complete, weight[new], fit[new], known[new], rays, looks, ranges)

    def _started(self, poses: Floats, ranges: Ranges, rays: Rays) -> Hypotheses:
        """Return hypotheses at poses (c, 3) that a search found."""
        scans = self.walls is not None and rays.hit.sum() >= verdict.FEW_ENDS
        covariances = np.tile(np.diag(np.square(_SIGMA_SCAN)), (len(poses), 1, 1))
        if not scans:
            hessian, _ = range_likelihood.range_factors(poses, ranges)
            covariances = np.linalg.inv(hessian + np.diag([0.01, 0.01, 0.1])) + np.diag(np.square(_SIGMA_FLOOR))
        fresh = hypotheses.started(poses, covariances, self.anchors)
        if self.walls is not None and rays.hit.sum() >= verdict.FEW_BESIDE:
            fresh = hypotheses.matched(fresh, self.walls, rays.spread(TRACK_RAYS), 1.0)
        return fresh


def _no_repetition(poses: Floats, weight: Floats, before: int) -> Bools:
    """Return which poses (h, 3) stay: the first ones, and those of the others that are no earlier one's place.

    One near an earlier one stays if it is far better: what was tracked there has slid along a wall, or was carried so far.
    """
    stays = np.ones(len(poses), bool)
    for k in range(before):
        stays[before:] &= hypotheses.apart(poses[k], poses[before:]) | (weight[before:] > weight[k] + verdict.CERTAIN)
    return stays


def _bounds(known: KnownMap) -> tuple[Floats, Floats]:
    """Return the corners (2,) of the area in which the robot may be, m."""
    if known.walls is not None:
        return known.walls.geometry.origin, known.walls.geometry.corner
    return known.anchors.positions.min(axis=0) - _RADIO_REACH, known.anchors.positions.max(axis=0) + _RADIO_REACH
