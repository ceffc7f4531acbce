"""An attempt at starting values: trajectory and anchors together, outwards from the best stretch.

Raw odometry of a long recording is too bent to linearise about, and anchors of unknown position cannot straighten it
before they are placed. So the stretch whose anchors are clearest comes first; from there the interval of known
poses extends at both ends. Each piece is appended by the calibrated odometry, optimised with the anchors already placed
(graduated kernel: wide first, then tight), and whenever the interval has grown by a certain share, all of it is solved
again and anchors not yet placed are searched from the poses so far.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from .. import se2
from ..arrays import OUTLIER, TINY, Bools, Floats, Ints, runs_of, spread
from ..graph.gnc import optimize_tightening
from ..graph.graph import Graph, edge_cost
from ..graph.pose_edges import OdometryEdges
from ..graph.range_edges import RangeEdges
from ..graph.robust import Kernel
from ..graph.solver import SolverConfig
from ..odometry.slips import LASTS, with_slips
from ..problem.alternatives import EvidencePolicy
from .range_measurements import log_densities
from .range_noise import RangeNoiseConfig, independent_shares
from .slip_search import TagRanges, bursts, likeliest_slip, log_prior
from .trilateration import AnchorHypothesis, TrilaterationConfig, ambiguous, trilaterate_each


class BootstrapPolicy:
    """How an attempt begins, grows, and is judged."""

    seed_distances: tuple[float, ...] = (25.0, 10.0, 4.0, 60.0, 150.0)
    starts: int = 5
    """Travelled distances of the first stretch, m, tried at so many places in this order until the anchors in it are clear;
    then all of the path."""
    clear_enough: float = 0.35
    seen: int = 3
    """Mean score of the anchors in a good first stretch, up to as many as constrain a pose; 1 = without error, 0 = unclear."""
    piece: float = 0.3
    growth: tuple[float, float] = (1.5, 0.8)
    """Distance appended at once, as a share of the first stretch, and factors on it where the prediction held and where not."""
    resolve_factor: float = 1.35
    """All poses so far are solved again when their number has increased by this factor."""
    scales: tuple[float, ...] = (20.0, 6.0, OUTLIER)
    """Scales of the ranges' kernel, one after the other, standard deviations."""
    solver: SolverConfig = SolverConfig(max_iterations=15, relative_decrease=1e-3)
    drift: float = 0.015
    """Assumed drift of the odometry per travelled metre, m/m."""
    heading_scales: tuple[float, ...] = tuple(2.0**k - 1.0 for k in (0, -1, 1, -0.5, 0.5, -0.25, 0.25))
    """Relative heading errors of the odometry, tried until the ranges agree: a wrong track width in the base's settings is the
    most frequent gross fault, and a factor of two its most frequent value; then its roots."""
    enough: float = 50.0
    """Travelled distance over which a heading error is tried before the whole path is, m."""
    agreement: float = 2.0
    """Ranges agree when their median error is below so many standard deviations."""
    tear: float = 1.0
    """Largest error of a step between keyframes by slip, m or rad; with a larger one a piece was appended mirrored or in the
    wrong place, even if its ranges agree well."""
    slipping_starts: int = 4
    """First stretches that are tried where the wheels slip."""


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
    sigma: float
    """Assumed standard deviation of ranges until it is learnt, m."""


class Attempt:
    """The poses in [low, high) are known, the anchors in `placed` have a position.

    Parameters
    ----------
    without : stretches, of poses first <= k < last, none of which the first one overlaps; wheels may slip then. None = they
        do not.
    """

    def __init__(
        self,
        graph: Graph,
        measured: Measured,
        search: TrilaterationConfig,
        without: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        self.seeks, self.without, self.first = without is not None, without or (), (0, 0)
        self.odometry, self.ranges, self.path = measured.odometry, measured.ranges, measured.path
        self.graph, self.assumed, self.search = graph, measured.sigma, search
        self.live = self.ranges.alive
        self.wheels, self.slips = self.odometry, np.zeros(len(self.odometry))
        self.poses = se2.chain(graph.poses[0], self.odometry.corrected(graph))
        self.anchors, self.calibration = graph.anchors.copy(), graph.calibration
        self.placed = np.zeros(len(graph.anchors), dtype=bool)
        self.sigma = np.full(len(graph.anchors), measured.sigma)
        self.hypotheses: dict[int, list[AnchorHypothesis]] = {}
        self.low = self.high = self.solved = 0
        self.piece = self.smallest = 0.0

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
            self.piece = BootstrapPolicy.piece * self._seed()
            self.first = self.low, self.high
            self.smallest, self.solved = BootstrapPolicy.piece * self.piece, self.high - self.low
            if self.placed.any():
                self._solve(BootstrapPolicy.scales[1:])
        while self.placed.any() and not self.complete and self.path[self.high - 1] - self.path[self.low] < enough:
            held, failed = BootstrapPolicy.growth
            self.piece = held * self.piece if self._extend(self.piece) else max(failed * self.piece, self.smallest)
            if self.high - self.low >= BootstrapPolicy.resolve_factor * self.solved or self.complete:
                self._solve(BootstrapPolicy.scales[1:])
                self.solved = self.high - self.low
                if self._adopt(self._search(self.low, self.high, 2.0 * self.assumed)):
                    self._solve(BootstrapPolicy.scales[1:])
                if not torn and self._is_torn():
                    break
        if np.isinf(enough):
            self._place_the_rest()

    def agrees_to_the_end(self) -> bool:
        """Extend as long as the ranges agree; return whether they do over the whole path."""
        length, agrees = BootstrapPolicy.enough, True
        while agrees and not self.complete:
            self.run(length, torn=False)
            length, agrees = 2.0 * length, bool(self.placed.any()) and self.misfit() < BootstrapPolicy.agreement
        self._place_the_rest()
        return agrees and self.complete

    def estimate(self) -> BootstrapResult:
        """Return the estimate of this attempt."""
        final = replace(self.graph, poses=self.poses, anchors=self.anchors, calibration=self.calibration)
        found = tuple(tuple(self.hypotheses.get(k, ())) for k in range(len(self.placed)))
        doubtful = np.array([ambiguous(each, self.search) for each in found], dtype=bool)
        return BootstrapResult(final, self.placed, found, doubtful, self.slips)

    def evidence(self) -> float:
        """Return the logarithm of the likelihood of wheels and ranges with the prior of the slips found, but for a constant.

        Of ranges the distribution of each anchor's errors is learnt, late and false ones included; neighbours are alike. So
        false ranges to one anchor in a row count about once, those to several at a time once for each.
        """
        part, number = self._part(self.low, self.high), len(runs_of(self.slips > 0.0))
        likely = -0.5 * sum(edge_cost(e, e.residuals(part)) for e in part.edges if not isinstance(e, RangeEdges))
        _, _, density, shares = self._errors(part)
        slips = number * log_prior(0.0, float(shares.sum()) / (number + 1))
        # How long slips last is exponentially distributed.
        return likely + float(shares @ density) + slips - float(self.odometry.duration[self.slips > 0.0].sum()) / LASTS

    def bursts(self) -> list[tuple[int, int]]:
        """Return first and last pose of the stretches in which ranges to all anchors are as those from elsewhere would be."""
        edges, errors, density, shares = self._errors(self._part(self.low, self.high))
        return [(self.low + a, self.low + b) for a, b in bursts(edges.pose, errors, density, shares)]

    def _errors(self, part: Graph) -> tuple[RangeEdges, Floats, Floats, Floats]:
        """Return the ranges of a part, their errors (m,), m, the logarithm of the density (m,) of each, 1/m, and the share (m,)
        of each that is independent of others."""
        edges = next((e for e in part.edges if isinstance(e, RangeEdges)), self.ranges.rows(np.zeros(0, dtype=np.intp)))
        groups = [edges.anchor == anchor for anchor in np.unique(edges.anchor)]
        shares = independent_shares(edges.tag_positions(part.poses), groups, RangeNoiseConfig())
        density, learnt = log_densities(edges, part, self.assumed)
        return edges, -edges.residuals(part)[:, 0] * edges.sigma, density, shares * (learnt > 0.0)

    def misfit(self) -> float:
        """Return the median error of ranges to placed anchors, in assumed standard deviations, as far as poses are known.

        A trajectory with a jump never agrees; without any anchor the misfit is 0.
        """
        part = self._part(self.low, self.high or len(self.path))
        errors = [e.residuals(part)[:, 0] * e.sigma for e in part.edges if isinstance(e, RangeEdges)]
        median = spread(errors[0]) / self.assumed if errors else 0.0
        return max(median, BootstrapPolicy.agreement) if self._is_torn() else median

    def _place_the_rest(self) -> None:
        """Put the anchors that stay unclear at their likeliest places."""
        for anchor, hypotheses in self.hypotheses.items():
            if hypotheses and not self.placed[anchor]:
                self._put(anchor, hypotheses[0])

    def _is_torn(self) -> bool:
        """Return whether a step of the known poses differs grossly from the odometry's."""
        low, high = self.low, self.high or len(self.path)
        off = se2.between(self._motion[low : high - 1], se2.between(self.poses[low : high - 1], self.poses[low + 1 : high]))
        return bool(np.any(np.abs(off[self.slips[low : high - 1] == 0.0]) > BootstrapPolicy.tear))

    @property
    def _motion(self) -> Floats:
        """(n - 1, 3) steps of the odometry, calibrated."""
        return self.odometry.corrected(replace(self.graph, calibration=self.calibration))

    def _seed(self) -> float:
        """Choose the stretch whose anchors are clearest, all of the path where none is clear anywhere, and place them.

        Returns its length, m.
        """
        best, most = None, 0.0
        total, count = float(self.path[-1]), min(len(np.unique(self.ranges.anchor[self.live])), BootstrapPolicy.seen)
        for length in [d for d in BootstrapPolicy.seed_distances if d < total] + [total]:
            places = 1 + max(0, min(BootstrapPolicy.starts, int(2 * total / max(length, TINY)) - 2))
            for start in np.linspace(0.0, total - length, places):
                low = int(np.searchsorted(self.path, start))
                high = int(np.searchsorted(self.path, start + length, "right"))
                if any(low < last and first < high for first, last in self.without) and length < total:
                    continue
                found = self._search(low, high, BootstrapPolicy.drift * length)
                clear = [h[0] for h in found.values() if h and not ambiguous(h, self.search)]
                worth = sum(1.0 / (1.0 + h.sigma / self.assumed + h.position_sigma) for h in clear)
                if worth > most + TINY or (best is None and length == total):
                    best, most = (found, low, high), worth
            if most > BootstrapPolicy.clear_enough * count:
                break
        assert best is not None
        found, self.low, self.high = best
        self._adopt(found)
        return float(self.path[self.high - 1] - self.path[self.low])

    def _rows(self, low: int, high: int, anchors: Bools) -> Ints:
        """Return the ranges from the poses in [low, high) to some of the anchors."""
        pose = self.ranges.pose
        return np.flatnonzero(self.live & (pose >= low) & (pose < high) & anchors[self.ranges.anchor])

    def _search(self, low: int, high: int, drift: float) -> dict[int, list[AnchorHypothesis]]:
        """Search the anchors not yet placed from the poses in [low, high)."""
        ranges = self.ranges.rows(self._rows(low, high, ~self.placed))
        anchors = np.unique(ranges.anchor).tolist()
        rows = [ranges.rows(ranges.anchor == anchor) for anchor in anchors]
        stretches = [(own.tag_positions(self.poses), own.planar_ranges()) for own in rows]
        return dict(zip(anchors, trilaterate_each(stretches, self.search, drift), strict=True))

    def _adopt(self, found: dict[int, list[AnchorHypothesis]]) -> bool:
        """Place the anchors with one clearly best hypothesis; keep all hypotheses; return whether any anchor was placed."""
        kept = {anchor: hypotheses for anchor, hypotheses in found.items() if hypotheses}
        clear = [anchor for anchor, hypotheses in kept.items() if not ambiguous(hypotheses, self.search)]
        self.hypotheses |= kept
        for anchor in clear:
            self._put(anchor, kept[anchor][0])
        return len(clear) > 0

    def _put(self, anchor: int, hypothesis: AnchorHypothesis) -> None:
        self.anchors[anchor] = hypothesis.position
        self.sigma[anchor] = max(hypothesis.sigma, self.sigma[anchor])
        self.placed[anchor] = True

    def _extend(self, piece: float) -> bool:
        """Append a piece, m, at each open end by odometry, mended where ranges contradict; return whether none did."""
        motion, agreed = self._motion, True
        if self.high < len(self.path):
            end, new = self.high - 1, int(np.searchsorted(self.path, self.path[self.high - 1] + piece, "right"))
            self.high = max(min(new, len(self.path)), end + 2)
            self.poses[end : self.high] = se2.chain(self.poses[end], motion[end : self.high - 1])
            agreed = self._agree_or_mend(end, self.high, end, piece)
        if self.low > 0:
            end, new = self.low, int(np.searchsorted(self.path, self.path[self.low] - piece))
            self.low = min(new, end - 1)
            back = se2.inverse(motion[self.low : end])[::-1]
            self.poses[self.low : end + 1] = se2.chain(self.poses[end], back)[::-1]
            agreed = self._agree_or_mend(self.low, end + 1, end, piece) and agreed
        return agreed

    def _agree_or_mend(self, low: int, high: int, end: int, piece: float) -> bool:
        """Return whether ranges from appended poses, beside a known one at an end of [low, high), agree with the prediction.

        Where they do not, the poses are optimised, and a slip is sought in them and as far again in what is known,
        up to the slip before. Anchors and calibration are fixed.
        """
        part = self._part(low, high)
        errors = [np.abs(e.residuals(part)) for e in part.edges if isinstance(e, RangeEdges)]
        if not errors or float(np.median(errors[0])) < BootstrapPolicy.agreement:
            return True
        self._anneal(low, high, end, BootstrapPolicy.scales)
        slips, forward = np.flatnonzero(self.slips > 0.0) + 1, end == low
        if forward:
            low = max(int(np.searchsorted(self.path, self.path[end] - piece)), int(slips[slips <= high].max(initial=self.low)))
        else:
            known = int(np.searchsorted(self.path, self.path[end] + piece, "right"))
            high = min(known, int(slips[slips > end].min(initial=self.high)))
        if self.seeks:
            self._with_slip(low, high, forward=forward)
        return False

    def _with_slip(self, low: int, high: int, *, forward: bool) -> None:
        """Let the wheels slip once in [low, high), where all is much likelier then than with wheels that are bent."""
        count, duration = len(self._rows(low, high, self.placed)), float(self.odometry.duration[low : high - 1].sum())
        prior, bent = log_prior(duration, count), self._cost(low, high)
        # Half the chi2 of a sound range is a half.
        hopeful = bent - 0.5 * count + prior >= EvidencePolicy.positive
        other = self.slipping(low, high, forward=forward) if hopeful else None
        if other is not None and bent - other._cost(low, high) + prior >= EvidencePolicy.positive:
            self.poses, self.slips, self.wheels = other.poses, other.slips, other.wheels

    def slipping(self, low: int, high: int, *, forward: bool) -> Self | None:
        """Return the attempt with the likeliest slip of the wheels in [low, high), None where there is none; forward: the pose
        at the lower end is known, not the other one."""
        rows, duration, motion = self.ranges.rows(self._rows(low, high, self.placed)), self.odometry.duration, self._motion
        arm, duration = rows.tag_positions(np.zeros_like(self.poses)), duration[low : high - 1]
        pose, steps, start = rows.pose - low, motion[low : high - 1], self.poses[low]
        if not forward:
            pose, steps, start = high - low - 1 - pose, se2.inverse(steps)[::-1], self.poses[high - 1]
            duration = duration[::-1]
        seen = TagRanges(pose, arm, self.anchors[rows.anchor], rows.planar_ranges(), self.sigma[rows.anchor])
        found = likeliest_slip(se2.chain(start, steps), duration, seen)
        if found is None:
            return None
        ends = (low + found.first, low + found.last) if forward else (high - 1 - found.last, high - 1 - found.first)
        other = self._copy()
        other.poses[low:high] = found.poses if forward else found.poses[::-1]
        other.slips[slice(*ends)] = 1.0
        other.wheels = with_slips(self.odometry, other.slips)
        other._anneal(low, high, low if forward else high - 1, BootstrapPolicy.scales[1:])
        return other

    def with_slips(self, slips: Floats) -> Self:
        """Return the attempt solved with probabilities (e,) that the wheels slip over each step."""
        other = self._copy()
        other.slips, other.wheels = slips, with_slips(self.odometry, slips)
        other._solve(BootstrapPolicy.scales[-1:])
        return other

    def mirrored(self) -> Self:
        """Return the attempt solved from the mirror image of its path and anchors, with the same slips."""
        other, place = self._copy(), np.array([1.0, -1.0])
        other.poses, other.anchors = other.poses * np.append(place, -1.0), other.anchors * place
        other.hypotheses = {
            anchor: [replace(each, position=each.position * place) for each in found]
            for anchor, found in self.hypotheses.items()
        }
        return other.with_slips(other.slips)

    def _copy(self) -> Self:
        other = copy(self)
        other.poses, other.sigma, other.slips = self.poses.copy(), self.sigma.copy(), self.slips.copy()
        return other

    def _cost(self, low: int, high: int) -> float:
        """Return half the robust chi2 of wheels and ranges over the poses [low, high), that of ranges as annealing ends."""
        part, kernel = self._part(low, high), Kernel("geman-mcclure", BootstrapPolicy.scales[-1])
        robust = (replace(e, kernel=kernel) if isinstance(e, RangeEdges) else e for e in part.edges)
        return 0.5 * float(sum(edge_cost(e, e.residuals(part)) for e in robust))

    def _anneal(self, low: int, high: int, fixed_pose: int, scales: tuple[float, ...]) -> None:
        """Optimise the poses of [low, high) with one of them, the anchors and the calibration fixed."""
        fixed = np.arange(low, high) == fixed_pose
        everything, unmoved = np.ones(len(self.anchors), dtype=bool), np.ones(len(self.calibration.values), dtype=bool)
        part = replace(self._part(low, high), fixed_poses=fixed, fixed_anchors=everything, fixed_calibration=unmoved)
        self.poses[low:high] = self._tightened(part, scales).poses

    def _solve(self, scales: tuple[float, ...]) -> None:
        """Optimise everything known so far and learn each anchor's spread."""
        part = replace(self._part(self.low, self.high), fixed_anchors=~self.placed)
        part = replace(part, fixed_calibration=self.graph.fixed_calibration).with_edges(*self.graph.edges)
        solved = self._tightened(part, scales)
        self.poses[self.low : self.high] = solved.poses
        self.anchors, self.calibration = solved.anchors.copy(), solved.calibration
        for edges in solved.edges:
            if isinstance(edges, RangeEdges):
                error = edges.residuals(solved)[:, 0] * edges.sigma
                for anchor in np.unique(edges.anchor):
                    self.sigma[anchor] = max(spread(error[edges.anchor == anchor]), self.assumed)

    def _tightened(self, graph: Graph, scales: tuple[float, ...]) -> Graph:
        """Optimise with the ranges' kernel tightened step by step (graduated non-convexity)."""
        ranges = [k for k, e in enumerate(graph.edges) if isinstance(e, RangeEdges)]
        return optimize_tightening(graph, ranges, scales, BootstrapPolicy.solver)

    def _part(self, low: int, high: int) -> Graph:
        """Return the graph of poses [low, high) with their odometry and their ranges to placed anchors."""
        wheels = self.wheels.rows(np.arange(low, max(high - 1, low)))
        wheels = replace(wheels, i=wheels.i - low, j=wheels.j - low)
        radio = self.ranges.rows(self._rows(low, high, self.placed))
        radio = replace(radio, pose=radio.pose - low, sigma=self.sigma[radio.anchor])
        alone = Graph(self.poses[low:high], self.anchors, (), self.calibration, work=self.graph.work)
        return alone.with_edges(wheels, radio)
