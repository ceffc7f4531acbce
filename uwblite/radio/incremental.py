"""Incremental optimisation of a graph whose initial values are only locally right: poses are added in time.

No descent from dead reckoning over kilometres finds the minimum, but the guess of the next hundred poses, appended to the
estimate so far, is always near. The last few hundred are optimised with older ones fixed; the whole is optimised again when it
is longer by half, or when the last part does not fit: when its chi2 per degree of freedom exceeds the usual by five standard
deviations, each of sqrt(2 / dof). Such a part is tried, in this order, without the anchors that were added last (mirror images
are recognised after a turn), without those most of whose ranges are outliers, and with more and more of the older poses free.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from .. import se2
from ..arrays import BEYOND_NOISE, ENOUGH, Bools, Ints
from ..graph.graph import Edges, Graph
from ..graph.problem_checks import check, given_anchors
from ..graph.range_edges import RangeEdges
from ..graph.robust import Kernel
from ..graph.solver import Progress, SolverConfig, SolverSummary, optimize
from ..graph.unknowns import free_unknowns
from ..problem.solution import rough
from .graph_starts import ranges_to
from .trilateration import TrilaterationConfig, ambiguous, trilaterate


@dataclass(frozen=True, slots=True)
class IncrementalPolicy:
    """How poses and anchors are added."""

    piece: ClassVar[int] = 100
    """Poses added at once; over so many the guess may not bend by more than about a radian."""
    window: ClassVar[int] = 4 * piece
    widening: ClassVar[int] = 4
    """Poses optimised after each piece, older ones fixed, and the factor on them where they do not fit; also those after which
    a new anchor is no longer the first to be removed."""
    resolve_factor: ClassVar[float] = 1.5
    """Everything is optimised again when there are so many times the poses, and an anchor searched again when there are so many
    times the ranges."""
    position_sigma: ClassVar[float] = 0.5
    drift: ClassVar[float] = 0.1
    """An anchor less certain than this is not added yet, m; assumed error of the path that it is searched from, m."""
    outlier: ClassVar[float] = 4.0
    outlier_share: ClassVar[float] = 0.3
    """Standard deviations beyond which a range is an outlier where optima are rough, and the share of these with which an
    anchor is removed."""
    search: ClassVar[TrilaterationConfig] = TrilaterationConfig(ambiguity=0.7)
    """Stricter than usual, since another try comes soon."""
    step: ClassVar[SolverConfig] = rough(SolverConfig())
    """Of the intermediate optimisations."""


def optimize_incrementally(
    graph: Graph, solver: SolverConfig = SolverConfig(), progress: Progress | None = None, allowed: float = np.inf
) -> tuple[Graph, SolverSummary]:
    """Optimise a graph whose poses stand in the order of time and are guessed by dead reckoning.

    Parameters
    ----------
    graph : its guess of the anchors is used only for those that are fixed, have a prior, or are in no range edges.
    solver : of the last optimisation.
    progress : called with (poses done, poses) after every piece.
    allowed : work, multiplications; where half of it is done before the end of the path, the rest of it is as guessed.

    Raises
    ------
    SolverError : nothing is free, nothing is measured, or a starting value is not finite.
    """
    check(graph)
    state = _Incremental(graph, 0.5 * allowed)
    for done in state.run():
        if progress is not None:
            progress(done, len(graph.poses))
    solved, summary = optimize(state.graph, solver, None, allowed - state.work)
    return solved, replace(summary, work=summary.work + state.work)


class _Kind(NamedTuple):
    """One kind of edges, sorted by the latest pose each touches."""

    edges: Edges
    latest: Ints
    """(e,) index of that pose, -1 = none."""
    anchors: tuple[Ints, ...]
    """(e,) each: anchors touched."""


def _by_time(edges: Edges, graph: Graph) -> _Kind:
    blocks = edges.linearize(graph).blocks
    latest = np.max([np.full(len(edges), -1), *(index for name, index, _ in blocks if name == "poses")], axis=0)
    order = np.argsort(latest, kind="stable")
    return _Kind(edges.rows(order), latest[order], tuple(i[order] for name, i, _ in blocks if name == "anchors"))


class _Part(NamedTuple):
    """A part of the graph, optimised."""

    graph: Graph
    fits: bool
    chi2_per_dof: float


class _Incremental:
    """The estimate so far: `graph` with the poses done, and which anchors were added."""

    def __init__(self, graph: Graph, allowed: float = np.inf) -> None:
        self.graph, self.guess = graph, graph.poses
        self.work, self.allowed = 0.0, allowed
        self.kinds = [_by_time(edges, graph) for edges in graph.edges]
        self.free = free_unknowns(graph)
        count = len(graph.anchors)
        given = given_anchors(graph)
        self.ranged = ~given & (self._counts(len(graph.poses)) > 0)
        self.joined = ~self.ranged
        self.joined_at = np.where(self.joined, -1, len(graph.poses))
        self.tried, self.usual = np.zeros(count, dtype=np.intp), 1.0
        first = np.full(count, len(self.guess))
        for kind in self.kinds:
            for anchors in kind.anchors:
                np.minimum.at(first, anchors, kind.latest)
        self.first_seen = np.where(given | self.ranged, -1, first)
        """When each anchor appears that has neither ranges nor a known place: from then on it moves with the path."""

    def _ranges(self, now: int) -> Iterator[RangeEdges]:
        """Yield the ranges so far."""
        for kind in self.kinds:
            if isinstance(kind.edges, RangeEdges):
                yield kind.edges.rows(np.arange(np.searchsorted(kind.latest, now)))

    def _counts(self, now: int) -> Ints:
        """Return how many ranges there are to each anchor so far (a,)."""
        count = len(self.graph.anchors)
        return sum((np.bincount(edges.anchor, minlength=count) for edges in self._ranges(now)), np.zeros(count, dtype=np.intp))

    def run(self) -> Iterator[int]:
        """Add poses up to the whole path, or while there is work allowed, yielding the number done."""
        done, whole = 0, 0
        while done < len(self.guess):
            if self.work >= self.allowed:
                self._lay_on(done, len(self.guess))
                return
            now = min(done + IncrementalPolicy.piece, len(self.guess))
            self._lay_on(done, now)
            everything = now == len(self.guess) or now >= IncrementalPolicy.resolve_factor * whole
            part = self._fit(now, everything)
            self.graph = replace(
                self.graph,
                poses=np.concatenate([part.graph.poses, self.graph.poses[now:]]),
                anchors=part.graph.anchors,
                calibration=part.graph.calibration,
            )
            if part.graph.fixed_calibration is self.graph.fixed_calibration:
                whole = now
                self.usual = max(1.0, part.chi2_per_dof) if np.isfinite(part.chi2_per_dof) else self.usual
            self._search(now)
            done = now
            yield done

    def _lay_on(self, done: int, now: int) -> None:
        """Continue the path by the motion of the guess, and move the anchors with it that have no ranges."""
        if not done:
            return
        poses, anchors = self.graph.poses.copy(), self.graph.anchors.copy()
        poses[done:now] = se2.compose(poses[done - 1], se2.between(self.guess[done - 1], self.guess[done:now]))
        new = np.flatnonzero((self.first_seen >= done) & (self.first_seen < now))
        at = self.first_seen[new]
        anchors[new] = se2.transform(se2.compose(poses[at], se2.inverse(self.guess[at])), anchors[new])
        self.graph = replace(self.graph, poses=poses, anchors=anchors)

    def _fit(self, now: int, everything: bool) -> _Part:
        """Optimise the last part, or as much more as it takes to fit."""
        window = now if everything else IncrementalPolicy.window
        while True:
            low = max(0, now - window)
            part = self._solve(low, now)
            if not part.fits:
                part = self._without_outliers(part, low, now)
            if part.fits or low == 0:
                return part
            window *= IncrementalPolicy.widening

    def _without_outliers(self, part: _Part, low: int, now: int) -> _Part:
        """Return the part without some anchors if it fits then, and remove these; otherwise return it unchanged."""
        fresh = self.joined & self.ranged & (self.joined_at >= now - IncrementalPolicy.window)
        for accused in (None, self._outlying):
            these = fresh if accused is None else accused(low, now)
            if these.any() and (other := self._solve(low, now, without=these)).fits:
                self.joined &= ~these
                self.joined_at[these] = len(self.guess)
                return other
        return part

    def _outlying(self, low: int, now: int) -> Bools:
        """Return the anchors most of whose ranges disagree with the rest, by a robust optimisation."""
        robust = self._solve(low, now, kernel=Kernel("geman-mcclure", IncrementalPolicy.outlier + 1.0)).graph
        measured, outliers = np.zeros(len(self.joined)), np.zeros(len(self.joined))
        for edges in robust.edges:
            if isinstance(edges, RangeEdges):
                off = np.abs(edges.residuals(robust)[:, 0]) > IncrementalPolicy.outlier
                measured += np.bincount(edges.anchor, minlength=len(measured))
                outliers += np.bincount(edges.anchor, off, len(measured))
        return self.ranged & (outliers > IncrementalPolicy.outlier_share * np.maximum(measured, 1.0))

    def _solve(self, low: int, now: int, without: Bools | None = None, kernel: Kernel | None = None) -> _Part:
        """Optimise poses low..now - 1 and the anchors added since; older ones are fixed."""
        use = self.joined if without is None else self.joined & ~without
        fixed = {name: ~mask for name, mask in self.free.items()}
        part = replace(
            self.graph,
            poses=self.graph.poses[:now],
            edges=tuple(self._edges(low, now, use, kernel)),
            fixed_poses=fixed["poses"][:now] | (np.arange(now) < low),
            fixed_anchors=fixed["anchors"] | ~use | (self.joined_at < low) & (low > 0),
            fixed_calibration=self.graph.fixed_calibration if low == 0 else np.ones_like(fixed["calibration"]),
        )
        if not part.edges or not any(mask.any() for mask in free_unknowns(part).values()):
            return _Part(part, True, float("nan"))
        solved, summary = optimize(part, IncrementalPolicy.step, None, self.allowed - self.work)
        self.work += summary.work
        scatter = np.sqrt(2.0 / max(summary.dof, 1))
        most = self.usual * (1.0 + BEYOND_NOISE * scatter)
        return _Part(solved, not summary.chi2_per_dof > most, summary.chi2_per_dof)

    def _edges(self, low: int, now: int, use: Bools, kernel: Kernel | None) -> Iterator[Edges]:
        for kind in self.kinds:
            first, end = np.searchsorted(kind.latest, [low if low else -1, now])
            which = np.arange(first, end)
            for anchors in kind.anchors:
                which = which[use[anchors[which]]]
            if len(which):
                edges = kind.edges.rows(which)
                yield replace(edges, kernel=kernel) if kernel is not None and isinstance(edges, RangeEdges) else edges

    def _search(self, now: int) -> None:
        """Place the anchors that the ranges so far make clear; at the end also those that stay doubtful."""
        last, counts, anchors = now == len(self.guess), self._counts(now), self.graph.anchors.copy()
        enough = counts >= np.maximum(ENOUGH, IncrementalPolicy.resolve_factor * self.tried)
        for anchor in np.flatnonzero(~self.joined & (last | enough)).tolist():
            self.tried[anchor] = counts[anchor]
            measured = (edges.rows(edges.anchor == anchor) for edges in self._ranges(now))
            found = trilaterate(*ranges_to(measured, self.graph.poses), IncrementalPolicy.search, IncrementalPolicy.drift)
            clear = bool(found) and not ambiguous(found, IncrementalPolicy.search)
            if found and (last or (clear and found[0].position_sigma < IncrementalPolicy.position_sigma)):
                anchors[anchor] = found[0].position
                self.joined[anchor], self.joined_at[anchor] = True, now
        self.graph = replace(self.graph, anchors=anchors)
