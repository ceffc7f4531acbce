"""An attempt at starting values: trajectory and anchors together, outwards from the best stretch.

Raw odometry of a long recording is too bent to linearise about, and anchors of unknown position cannot straighten it
before they are placed. So the stretch whose anchors are clearest comes first; from there the interval of known
poses extends at both ends. Each piece is appended by the calibrated odometry, optimised with the anchors already placed
(graduated kernel: wide first, then tight), and whenever the interval has grown by a certain share, all of it is solved
again and anchors not yet placed are searched from the poses so far.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, runs_of, spread
from ..config import setting
from ..graph.gnc import tightened
from ..graph.graph import Graph, edge_cost
from ..graph.pose_edges import OdometryEdges
from ..graph.range_edges import RangeEdges
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig
from ..odometry.slips import with_slips
from ..problem.alternatives import EvidencePolicy
from . import nlos_mixture
from .range_noise import RangeNoiseConfig, independent_shares
from .slip_search import TagRanges, likeliest_slip, log_prior
from .trilateration import AnchorHypothesis, TrilaterationConfig, ambiguous, trilaterate_each


@dataclass(frozen=True, slots=True)
class BootstrapConfig:
    """Bootstrap of the first estimate."""

    seed_distances: ClassVar[tuple[float, ...]] = (25.0, 10.0, 4.0, 60.0, 150.0)
    """Travelled distances of the first stretch, m, tried in this order until the anchors in it are clear; then all of it."""
    piece: ClassVar[float] = 0.3
    """Distance appended at once, as a share of the first stretch; more where the prediction holds."""
    resolve_factor: ClassVar[float] = 1.35
    """All poses so far are solved again when their number has increased by this factor."""
    range_sigma: float = setting(0.15, advanced=True)
    """Assumed standard deviation of ranges until it is learnt, m."""
    drift: ClassVar[float] = 0.015
    """Assumed drift of the odometry per travelled metre, m/m."""
    heading_scales: ClassVar[tuple[float, ...]] = (0.0, -0.5, 1.0, -0.3, 0.4, -0.15, 0.15)
    """Relative heading errors of the odometry, tried in this order until the ranges agree: a wrong track width in the
    base's settings is the most frequent gross fault, and a factor of two its most frequent value."""
    agreement: ClassVar[float] = 2.0
    """Ranges agree when their median error is below so many standard deviations."""
    enough: ClassVar[float] = 50.0
    """Travelled distance over which a heading error is tried before the whole path is, m."""
    tear: ClassVar[float] = 1.0
    """Largest error of a step between keyframes by slip, m or rad; with a larger one a piece was appended mirrored or in the
    wrong place, even if its ranges agree well."""
    clear_enough: ClassVar[float] = 0.35
    """A first stretch is good when its anchors (up to three) have this mean score; 1 = placed without error, 0 = unclear."""


@dataclass(frozen=True, slots=True, eq=False)
class BootstrapResult:
    """Starting values for the first optimisation."""

    graph: Graph
    """Odometry edges of the whole path; ranges of placed anchors."""
    placed: Bools
    """(a,) anchors that have a position."""
    hypotheses: tuple[tuple[AnchorHypothesis, ...], ...]
    """By anchor: what the last search found, best first."""
    ambiguous: Bools
    """(a,) two positions explain the ranges about equally well."""
    slips: Floats = field(default_factory=lambda: np.zeros(0))
    """(e,) probability that the wheels slipped over each step; empty = not sought."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What a bootstrap rests on."""

    odometry: OdometryEdges
    """Between consecutive poses."""
    ranges: RangeEdges
    """All; those that cannot be distances have weight 0."""
    path: Floats
    """(k,) travelled distance at each pose, m."""


class Attempt:
    """The poses in [low, high) are known, the anchors in `placed` have a position."""

    def __init__(
        self,
        graph: Graph,
        measured: Measured,
        config: BootstrapConfig,
        search: TrilaterationConfig,
        without: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        """Take what is known.

        Parameters
        ----------
        without : stretches, of poses first <= k < last, none of which the first one overlaps; wheels may slip then. None = they
            do not.
        """
        self.seeks, self.without, self.first = without is not None, without or (), (0, 0)
        self.odometry, self.ranges, self.path = measured.odometry, measured.ranges, measured.path
        self.graph, self.config, self.search = graph, config, search
        self.live = self.ranges.alive
        self.wheels, self.slips = self.odometry, np.zeros(len(self.odometry))
        self.poses = se2.chain(graph.poses[0], self.odometry.corrected(graph))
        self.anchors, self.calibration = graph.anchors.copy(), graph.calibration
        self.placed = np.zeros(len(graph.anchors), dtype=bool)
        self.sigma = np.full(len(graph.anchors), config.range_sigma)
        self.hypotheses: dict[int, list[AnchorHypothesis]] = {}
        self.low = self.high = self.solved = 0
        self.piece = self.smallest = 0.0
        self.begun = np.zeros((0, 2))

    @property
    def complete(self) -> bool:
        """Whether all poses are known."""
        return self.low == 0 and self.high == len(self.path)

    def run(self, enough: float = np.inf, *, torn: bool = True) -> None:
        """Extend from the clearest stretch, or from where it was left, to a travelled distance, m, or to the whole path.

        Parameters
        ----------
        torn : continue where the trajectory has a jump; no attempt with a jump agrees with the ranges later.
        """
        if self.high == 0:
            self._begin()
        while self.placed.any() and not self.complete and self.path[self.high - 1] - self.path[self.low] < enough:
            agreed = self._extend(self.piece)
            self.piece = 1.5 * self.piece if agreed else max(0.8 * self.piece, self.smallest)
            if self.high - self.low >= self.config.resolve_factor * self.solved or self.complete:
                self._solve(_SCALES[1:])
                self.solved = self.high - self.low
                if self._adopt(self._search(self.low, self.high, 2.0 * self.config.range_sigma)):
                    self._solve(_SCALES[1:])
                if not torn and self._is_torn():
                    break
        if np.isinf(enough):
            self._place_the_rest()

    def agrees_to_the_end(self) -> bool:
        """Extend as long as the ranges agree; return whether they do over the whole path."""
        length = self.config.enough
        while not self.complete and self.misfit() < self.config.agreement:
            length *= 2.0
            self.run(length)
        if self.complete:
            self._place_the_rest()
        return self.complete and self.misfit() < self.config.agreement

    def _begin(self) -> None:
        """Solve the clearest stretch."""
        self.piece = self.config.piece * self._seed()
        self.first = self.low, self.high
        self.smallest, self.solved = 0.3 * self.piece, self.high - self.low
        if self.placed.any():
            self._solve((10.0, 3.0))
        known = np.zeros(len(self.path), dtype=bool)
        known[self.low : self.high] = True
        places = np.concatenate([self.poses[:, :2], self.anchors])
        places[~np.concatenate([known, self.placed])] = np.nan
        self.begun = se2.transform(se2.inverse(self.poses[self.low]), places)

    def began_like(self, other: Self) -> bool:
        """Return whether poses and anchors of the clearest stretch are another attempt's, up to the noise of a range."""
        apart = np.hypot(*(self.begun - other.begun).T)
        same = np.array_equal(np.isnan(self.begun), np.isnan(other.begun))
        return same and float(np.nanmax(apart)) < self.config.range_sigma

    def _place_the_rest(self) -> None:
        """Put the anchors that stay unclear at their likeliest places."""
        self.doubtful = np.array([self._unclear(self.hypotheses.get(k, [])) for k in range(len(self.placed))], dtype=bool)
        for anchor, hypotheses in self.hypotheses.items():
            if hypotheses and not self.placed[anchor]:
                self._put(anchor, hypotheses[0])

    def estimate(self) -> BootstrapResult:
        """Return the estimate of this attempt."""
        final = replace(self.graph, poses=self.poses, anchors=self.anchors, calibration=self.calibration)
        found = tuple(tuple(self.hypotheses.get(k, ())) for k in range(len(self.placed)))
        return BootstrapResult(final, self.placed, found, self.doubtful, self.slips)

    def evidence(self) -> float:
        """Return the logarithm of the likelihood of wheels and ranges with the prior of the slips found, but for a constant.

        Of ranges the distribution of each anchor's errors is learnt, late and false ones included; neighbours are alike.
        """
        part, number = self._part(self.low, self.high), len(runs_of(self.slips > 0.0))
        likely = independent = 0.0
        for edges in part.edges:
            if isinstance(edges, RangeEdges):
                errors = -edges.residuals(part)[:, 0] * edges.sigma
                groups = [edges.anchor == anchor for anchor in np.unique(edges.anchor)]
                shares = independent_shares(edges.tag_positions(part.poses), groups, RangeNoiseConfig())
                independent += float(shares.sum())
                for own in groups:
                    mixture = nlos_mixture.fit(errors[own], self.config.range_sigma)
                    likely += float(shares[own] @ mixture.log_density(errors[own]))
            else:
                likely -= 0.5 * float(edge_cost(edges, edges.residuals(part)))
        return likely + number * log_prior(0.0, independent / (number + 1))

    def misfit(self) -> float:
        """Return the median error of ranges to placed anchors, in assumed standard deviations, as far as poses are known.

        A trajectory with a jump never agrees; without any anchor the misfit is 0.
        """
        low, high = self.low, self.high or len(self.path)
        part = self._part(low, high)
        errors = [np.abs(e.residuals(part)[:, 0] * e.sigma) for e in part.edges if isinstance(e, RangeEdges)]
        median = float(np.median(errors[0])) / (0.6745 * self.config.range_sigma) if errors else 0.0
        return max(median, self.config.agreement) if self._is_torn() else median

    def _is_torn(self) -> bool:
        """Return whether a step of the known poses differs grossly from the odometry's."""
        low, high = self.low, self.high or len(self.path)
        steps = self.odometry.corrected(replace(self.graph, calibration=self.calibration))[low : high - 1]
        off = se2.between(steps, se2.between(self.poses[low : high - 1], self.poses[low + 1 : high]))
        return bool(np.any(np.abs(off[self.slips[low : high - 1] == 0.0]) > self.config.tear))

    def _unclear(self, hypotheses: list[AnchorHypothesis]) -> bool:
        return len(hypotheses) > 0 and ambiguous(hypotheses, self.search)

    def _seed(self) -> float:
        """Choose the stretch whose anchors are clearest, all of the path where none is clear anywhere, and place them.

        Returns its length, m.
        """
        best, most = None, 0.0
        total, count = float(self.path[-1]), min(len(np.unique(self.ranges.anchor[self.live])), 3)
        for length in [d for d in self.config.seed_distances if d < total] + [total]:
            places = 1 + max(0, min(5, int(2 * total / max(length, 1e-9)) - 2))
            for start in np.linspace(0.0, total - length, places):
                low = int(np.searchsorted(self.path, start))
                high = int(np.searchsorted(self.path, start + length, "right"))
                if any(low < last and first < high for first, last in self.without) and length < total:
                    continue
                found = self._search(low, high, self.config.drift * length)
                clear = [h[0] for h in found.values() if h and not self._unclear(h)]
                worth = sum(1.0 / (1.0 + h.sigma / self.config.range_sigma + h.position_sigma) for h in clear)
                if worth > most + 1e-9 or (best is None and length == total):
                    best, most = (found, low, high), worth
            if most > self.config.clear_enough * count:
                break
        assert best is not None
        found, self.low, self.high = best
        self._adopt(found)
        return float(self.path[self.high - 1] - self.path[self.low])

    def _search(self, low: int, high: int, drift: float) -> dict[int, list[AnchorHypothesis]]:
        """Search the anchors not yet placed from the poses in [low, high)."""
        ranges, inside = self.ranges, self.live & (self.ranges.pose >= low) & (self.ranges.pose < high)
        anchors = [anchor for anchor in np.unique(ranges.anchor[inside]).tolist() if not self.placed[anchor]]
        rows = [ranges.rows(inside & (ranges.anchor == anchor)) for anchor in anchors]
        stretches = [(own.tag_positions(self.poses), own.planar_ranges()) for own in rows]
        return dict(zip(anchors, trilaterate_each(stretches, self.search, drift), strict=True))

    def _adopt(self, found: dict[int, list[AnchorHypothesis]]) -> bool:
        """Place the anchors with one clearly best hypothesis; keep all hypotheses; return whether any anchor was placed."""
        any_new = False
        for anchor, hypotheses in found.items():
            if hypotheses:
                self.hypotheses[anchor] = hypotheses
                if not self._unclear(hypotheses):
                    self._put(anchor, hypotheses[0])
                    any_new = True
        return any_new

    def _put(self, anchor: int, hypothesis: AnchorHypothesis) -> None:
        self.anchors[anchor] = hypothesis.position
        self.sigma[anchor] = max(hypothesis.sigma, self.sigma[anchor])
        self.placed[anchor] = True

    def _extend(self, piece: float) -> bool:
        """Append one piece at each open end by calibrated odometry; return whether it agreed with the anchors unchanged."""
        motion = self.odometry.corrected(replace(self.graph, calibration=self.calibration))
        agreed = True
        if self.high < len(self.path):
            old, new = self.high, int(np.searchsorted(self.path, self.path[self.high - 1] + piece, "right"))
            self.high = max(min(new, len(self.path)), old + 1)
            self.poses[old - 1 : self.high] = se2.chain(self.poses[old - 1], motion[old - 1 : self.high - 1])
            if not self._optimise_piece(old - 1, self.high, old - 1):
                agreed = False
                begin = int(np.searchsorted(self.path, self.path[old - 1] - piece))
                self._with_slip(max(begin, self.low, self._last_slip(old)), self.high, motion, forward=True)
        if self.low > 0:
            old, new = self.low, int(np.searchsorted(self.path, self.path[self.low] - piece))
            self.low = min(new, old - 1)
            back = se2.inverse(motion[self.low : old])[::-1]
            self.poses[self.low : old + 1] = se2.chain(self.poses[old], back)[::-1]
            if not self._optimise_piece(self.low, old + 1, old):
                agreed = False
                end = int(np.searchsorted(self.path, self.path[old] + piece, "right"))
                self._with_slip(self.low, min(end, self.high, self._next_slip(old)), motion, forward=False)
        return agreed

    def _last_slip(self, before: int) -> int:
        """Return the pose at which the last slip before a pose ends."""
        found = np.flatnonzero(self.slips[:before] > 0.0)
        return int(found[-1]) + 1 if len(found) else 0

    def _next_slip(self, after: int) -> int:
        """Return the number of poses until the next slip after a pose begins."""
        found = np.flatnonzero(self.slips[after:] > 0.0)
        return after + int(found[0]) + 1 if len(found) else len(self.path)

    def _with_slip(self, low: int, high: int, motion: Floats, *, forward: bool) -> None:
        """Let the wheels slip once in [low, high), where all is much likelier then than with wheels that are bent.

        Parameters
        ----------
        motion : (n - 1, 3) of the wheels, calibrated. forward : whether the pose at the lower end is known, not the other one.
        """
        if not self.seeks:
            return
        own = self.live & (self.ranges.pose >= low) & (self.ranges.pose < high) & self.placed[self.ranges.anchor]
        rows, duration = self.ranges.rows(np.flatnonzero(own)), self.odometry.duration[low : high - 1]
        prior, bent = log_prior(float(duration.sum()), len(rows)), self._cost(low, high)
        if bent - _USUAL * len(rows) + prior < EvidencePolicy.positive:
            return
        arm = rows.lever_arm + se2.rotate(rows.turn, np.broadcast_to(rows.tag, (len(rows), 2)))
        pose, steps, start = rows.pose - low, motion[low : high - 1], self.poses[low]
        if not forward:
            pose, steps, start = high - low - 1 - pose, se2.inverse(steps)[::-1], self.poses[high - 1]
            duration = duration[::-1]
        seen = TagRanges(pose, arm, self.anchors[rows.anchor], rows.planar_ranges(), self.sigma[rows.anchor])
        found = likeliest_slip(se2.chain(start, steps), duration, seen)
        if found is None:
            return
        before = self.poses.copy(), self.slips.copy(), self.wheels
        ends = (low + found.first, low + found.last) if forward else (high - 1 - found.last, high - 1 - found.first)
        self.poses[low:high] = found.poses if forward else found.poses[::-1]
        self.slips[slice(*ends)] = 1.0
        self.wheels = with_slips(self.odometry, self.slips)
        self._anneal_poses(low, high, low if forward else high - 1, _SCALES[1:])
        if bent - self._cost(low, high) + prior < EvidencePolicy.positive:
            self.poses, self.slips, self.wheels = before

    def _cost(self, low: int, high: int) -> float:
        """Return half the robust chi2 of wheels and ranges over the poses [low, high), that of ranges as annealing ends."""
        part, kernel = self._part(low, high), Kernel("geman-mcclure", _SCALES[-1])
        robust = (replace(e, kernel=kernel) if isinstance(e, RangeEdges) else e for e in part.edges)
        return 0.5 * float(sum(edge_cost(e, e.residuals(part)) for e in robust))

    def _optimise_piece(self, low: int, high: int, fixed_pose: int) -> bool:
        """Optimise the poses of [low, high) with one of them, the anchors and the calibration fixed.

        Returns True where the ranges agreed with the prediction; then nothing is moved.
        """
        part = self._part(low, high)
        errors = [e.residuals(part) for e in part.edges if isinstance(e, RangeEdges)]
        if not errors or float(np.median(np.abs(errors[0]))) < 2.0:
            return True
        self._anneal_poses(low, high, fixed_pose, _SCALES)
        return False

    def _anneal_poses(self, low: int, high: int, fixed_pose: int, schedule: tuple[float, ...]) -> None:
        """Optimise the poses of [low, high) with one of them, the anchors and the calibration fixed."""
        fixed = np.arange(low, high) == fixed_pose
        everything, unmoved = np.ones(len(self.anchors), dtype=bool), np.ones(len(self.calibration.values), dtype=bool)
        part = replace(self._part(low, high), fixed_poses=fixed, fixed_anchors=everything, fixed_calibration=unmoved)
        self.poses[low:high] = _anneal(part, schedule).poses

    def _solve(self, schedule: tuple[float, ...]) -> None:
        """Optimise everything known so far and learn each anchor's spread."""
        part = replace(self._part(self.low, self.high), fixed_anchors=~self.placed)
        part = replace(part, fixed_calibration=self.graph.fixed_calibration).with_edges(*self.graph.edges)
        solved = _anneal(part, schedule)
        self.poses[self.low : self.high] = solved.poses
        self.anchors, self.calibration = solved.anchors.copy(), solved.calibration
        for edges in solved.edges:
            if isinstance(edges, RangeEdges):
                error = edges.residuals(solved)[:, 0] * edges.sigma
                for anchor in np.unique(edges.anchor):
                    self.sigma[anchor] = max(spread(error[edges.anchor == anchor]), self.config.range_sigma)

    def _part(self, low: int, high: int) -> Graph:
        """Return the graph of poses [low, high) with their odometry and their ranges to placed anchors."""
        wheels = self.wheels.rows(np.arange(low, max(high - 1, low)))
        wheels = replace(wheels, i=wheels.i - low, j=wheels.j - low)
        which = self.live & (self.ranges.pose >= low) & (self.ranges.pose < high) & self.placed[self.ranges.anchor]
        radio = self.ranges.rows(np.flatnonzero(which))
        radio = replace(radio, pose=radio.pose - low, sigma=self.sigma[radio.anchor])
        alone = Graph(self.poses[low:high], self.anchors, (), self.calibration, work=self.graph.work)
        return alone.with_edges(wheels, radio)


_SCALES = (20.0, 6.0, 3.0)
"""Scales of the ranges' kernel, one after the other, standard deviations."""
_USUAL = 0.5
"""Half the chi2 of a sound range."""


def _anneal(graph: Graph, schedule: tuple[float, ...]) -> Graph:
    """Optimise with the ranges' kernel tightened step by step (graduated non-convexity)."""
    ranges = [k for k, e in enumerate(graph.edges) if isinstance(e, RangeEdges)]
    return tightened(graph, ranges, schedule, SolverConfig(max_iterations=15, relative_decrease=1e-3))
