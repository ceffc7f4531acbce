"""Comparison of places in the map: how well each explains the measurements of the last metres."""

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, concatenated
from . import hypotheses, range_model, search, verdict
from .hypotheses import Hypotheses
from .known_map import KnownMap
from .range_model import Ranges
from .sensing import TRACK_RAYS
from .walls import INDEPENDENT_RAYS, PER_FACTOR, PER_RAY, Rays
from .window import Window

LOOK_BACK = 4.0
"""m driven; the search makes one cloud of the scans of the last metres, and places are compared by them."""
_SIGMA_FLOOR = (0.1, 0.1, 0.03)
"""m, m, rad; drift within the window, in addition to the uncertainty by ranges."""
_FLAT = 3.0
"""Variances by ranges alone over what the curvature of their kernel says: with detours their likelihood is flat."""
_RADIO_REACH = 15.0
"""m beyond the outermost anchors; limit of the area of the robot in a map without a grid."""


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Places in the map, and how well each (h,) explains the measurements."""

    bank: Hypotheses
    """The present hypotheses first."""
    complete: bool
    """No equally good place was left out."""
    weight: Floats
    """Log-likelihood."""
    scans: Floats
    """By the rays alone, against a place elsewhere."""
    known: Floats
    """Rays' ends in known space."""
    rays: Rays
    """Of the last metres, in the present frame of the base."""
    independent: float
    """How many of them count as independent."""
    ranges: Ranges

    @property
    def hypotheses(self) -> Hypotheses:
        """All places, weighted by this alone."""
        return hypotheses.reweighted(Hypotheses(self.bank.mean, self.bank.covariance, np.zeros(len(self.bank))), self.weight)

    @property
    def elsewhere(self) -> bool:
        """Whether another place explains the measurements better than the first hypothesis."""
        return self.complete and bool(self.weight[1:].max(initial=-np.inf) > self.weight[0] + verdict.CERTAIN)


class PlaceSearch:
    """The whole map, ready for a search in small units of work.

    A search and the comparison of what it found are made in the frame that the robot had at their beginning.
    """

    def __init__(self, known: KnownMap) -> None:
        self.walls, self._anchors, places = known.walls, known.anchors, known.anchors.positions
        if self.walls is None:
            self._field, self._bounds = None, (places.min(axis=0) - _RADIO_REACH, places.max(axis=0) + _RADIO_REACH)
        else:
            self._field, self._bounds = search.field_of(self.walls), (self.walls.geometry.origin, self.walls.geometry.corner)
        self._odom = np.zeros(0)
        self._present = np.zeros((0, 0))
        """(h, 3) poses of the present hypotheses, as of the search's beginning."""
        self._steps: Generator[int, None, Comparison] | None = None

    @property
    def idle(self) -> bool:
        """Whether no search is under way."""
        return self._steps is None

    def begin(self, window: Window, odom: Floats, way: float, candidates: Floats) -> None:
        """Begin to search the whole map with the measurements of a window, at a pose (3,) and way, m, of the odometry.

        Parameters
        ----------
        candidates : (c, 3) poses that are compared beside those that the search finds, by the same measurements.
        """
        self._odom = odom.copy()
        ranges = window.ranges_since(self._anchors, odom, way)
        self._steps = self._compared(ranges, *window.seen(odom, way, LOOK_BACK), candidates)

    def drop(self) -> None:
        """Cancel a running search."""
        self._steps = None

    def advance(self, bank: Hypotheses, odom: Floats) -> tuple[Comparison | None, int]:
        """Do some units of work; return the comparison, if that was the last unit, and the operations that were done.

        Parameters
        ----------
        bank : the present hypotheses, row by row the same ones from the beginning of the search on.
        odom : (3,) present pose in the odometry frame.
        """
        if self._steps is None:
            return None, 0
        done = 0
        self._present = se2.compose(bank.poses, se2.between(odom, self._odom))
        try:
            while done < search.UNIT:
                done += next(self._steps)
        except StopIteration as end:
            self._steps = None
            return self._brought(end.value, bank, odom), done
        return None, done

    def _compared(self, ranges: Ranges, rays: Rays, ago: Floats, candidates: Floats) -> Generator[int, None, Comparison]:
        """Search for places and weight them, candidates (c, 3) and the present hypotheses, by rays (p,) of so many metres ago.

        In the bank of the comparison are the new places alone.
        """
        found = yield from search.places(self._field, rays, ranges, self._bounds)
        parts = []
        match = hypotheses.MATCHES * PER_FACTOR * min(len(rays.hit), TRACK_RAYS)
        tried = np.concatenate([found.poses, candidates[hypotheses.apart(candidates[:, None], found.poses).all(axis=1)]])
        for part in search.units(max(len(tried), 1), match):
            parts.append(self._started(tried[part], ranges, rays))
            yield match * len(parts[-1])
        started = concatenated(parts)
        before, poses = len(self._present), np.concatenate([self._present, started.poses])
        weight, scans, known = np.zeros((3, len(poses)))
        independent = INDEPENDENT_RAYS * (1.0 + float(ago.max(initial=0.0)))
        if self.walls is not None and len(rays.hit):
            for part in search.units(len(poses), PER_RAY * len(rays.hit)):
                agreement = self.walls.agreement(poses[part], rays, independent)
                weight[part], scans[part] = agreement.log_likelihood, independent * agreement.odds
                known[part] = agreement.known
                yield PER_RAY * len(poses[part]) * len(rays.hit)
        errors, each = self._anchors.errors, (range_model.PER_RANGE + range_model.PER_EXPECTED) * len(ranges)
        for part in search.units(len(poses), each):
            expected = range_model.expected_errors(poses[part], ranges, errors) if errors else None
            weight[part] += range_model.range_likelihood(poses[part], ranges, expected=expected)
            yield each * len(poses[part])
        new = _no_repetition(poses, weight, before)
        places = started.rows(new[before:])
        return Comparison(places, found.complete, weight[new], scans[new], known[new], rays, independent, ranges)

    def _brought(self, found: Comparison, bank: Hypotheses, odom: Floats) -> Comparison:
        """Return a comparison in the present frame of the robot, with the present hypotheses as they are now first."""
        back, mean = se2.between(odom, self._odom), found.bank.mean.copy()
        mean[:, hypotheses.POSE] = se2.compose(found.bank.poses, se2.between(self._odom, odom))
        ranges = replace(found.ranges, tags=se2.transform(back, found.ranges.tags))
        both = concatenated([bank, replace(found.bank, mean=mean)])
        return replace(found, bank=both, rays=found.rays.moved(back), ranges=ranges)

    def _started(self, poses: Floats, ranges: Ranges, rays: Rays) -> Hypotheses:
        """Return hypotheses at poses (c, 3) that a search found."""
        few, anchors = rays.spread(TRACK_RAYS), self._anchors
        walls = self.walls if few.hit.sum() >= verdict.FEW_BESIDE else None
        poses = hypotheses.refined(poses, ranges, walls, few)
        hessian, _ = range_model.range_factors(poses, ranges)
        hessian /= _FLAT if walls is None else 1.0
        covariances = np.linalg.inv(hessian + range_model.POOR) + np.diag(np.square(_SIGMA_FLOOR))
        fresh = hypotheses.started(poses, covariances, anchors.bias_sigma)
        return fresh if walls is None else hypotheses.matched(fresh, walls, few, 1.0)


def _no_repetition(poses: Floats, weight: Floats, before: int) -> Bools:
    """Return which poses (h, 3) stay: the first ones, and those of the others that are no earlier one's place.

    One near an earlier one stays if it is far better: the tracked pose has slid along a wall.
    """
    better = weight[before:] > weight[:before, None] + verdict.CERTAIN
    new = (hypotheses.apart(poses[:before, None], poses[before:]) | better).all(axis=0)
    return np.concatenate([np.ones(before, bool), new])
