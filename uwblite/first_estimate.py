"""Starting values from nothing: the trajectory and the anchors grow together, outwards from the best stretch.

Raw odometry of a long run is too bent to linearise about, and anchors of unknown position cannot straighten it
before they are placed. So the stretch whose anchors are clearest comes first; from there the interval of known
poses grows at both ends. Each piece is laid on by the calibrated odometry, pulled onto the anchors already placed
(graduated kernel: wide first, then tight), and whenever the interval has grown by a share, all of it is solved
again and anchors not yet placed are searched from the poses so far.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from . import se2
from .anchors import AnchorConfig, AnchorHypothesis, ambiguous, locate, usable
from .graph import Calibration, Graph, OdometryEdges, RangeEdges
from .robust import Kernel
from .solver import SolverConfig, optimize

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class GrowthConfig:
    """How the first estimate grows."""

    seed_distances: tuple[float, ...] = (25.0, 10.0, 4.0, 60.0, 150.0)
    """Travelled distances of the first stretch, m, tried in this order until the anchors in it are clear; then all of it."""
    piece: float = 0.3
    """Distance laid on at once, as a share of the first stretch; more where the prediction holds."""
    resolve_growth: float = 1.35
    """All poses so far are solved again when their number has grown by this factor."""
    range_sigma: float = 0.15
    """Assumed standard deviation of ranges until it is learnt, m."""
    least_sigma: float = 0.05
    """Ranges are not trusted below this while it grows, m."""
    drift: float = 0.015
    """Assumed drift of the odometry per travelled metre, m/m."""
    heading_scales: tuple[float, ...] = (0.0, -0.5, 1.0, -0.3, 0.4, -0.15, 0.15)
    """Relative heading errors of the odometry tried in this order until the anchors are clear: a wrong track width
    in the base's settings is the commonest gross fault, and a factor of two the commonest value."""
    clear_enough: float = 0.35
    """A first stretch is good when its anchors (up to three) are worth this each; 1 = placed without error, 0 = unclear."""


@dataclass(frozen=True, slots=True, eq=False)
class FirstEstimate:
    """Starting values for the first optimisation."""

    graph: Graph
    """Odometry edges of the whole path; ranges of placed anchors."""
    placed: Bools
    """(a,) anchors that have a position."""
    hypotheses: tuple[tuple[AnchorHypothesis, ...], ...]
    """By anchor: what the last search found, best first."""
    ambiguous: Bools
    """(a,) two positions explain the ranges about equally well."""


@dataclass(slots=True)
class _Growing:
    """State of the growth: poses in [low, high) are known."""

    poses: Floats
    anchors: Floats
    calibration: Calibration
    placed: Bools
    sigma: Floats
    low: int = 0
    high: int = 0
    hypotheses: dict[int, tuple[AnchorHypothesis, ...]] = field(default_factory=dict)


def grow(
    graph: Graph, odometry: OdometryEdges, ranges: RangeEdges, path: Floats, config: GrowthConfig, search: AnchorConfig
) -> FirstEstimate:
    """Estimate poses and anchor positions without any guess of the anchors.

    Parameters
    ----------
    graph : poses (k, 3) by dead reckoning, anchors (a, 2) of any value, calibration block; its edges (priors) stay.
    odometry : k - 1 edges between consecutive poses.
    ranges : all ranges; those that cannot be distances must have weight 0.
    path : (k,) travelled distance at each pose, m.
    config, search : settings.
    """
    anchors = len(graph.anchors)
    state = _Growing(graph.poses.copy(), graph.anchors.copy(), graph.calibration, np.zeros(anchors, dtype=bool), np.full(anchors, config.range_sigma))
    live = np.ones(len(ranges), dtype=bool) if ranges.weights is None else ranges.weights > 0
    piece = config.piece * _seed(state, graph, odometry, ranges, live, path, config, search)
    smallest = 0.3 * piece
    if state.placed.any():
        _solve(state, graph, odometry, ranges, live, config, (10.0, 3.0))
        solved = state.high - state.low
        while state.low > 0 or state.high < len(path):
            held = _extend(state, graph, odometry, ranges, live, path, piece)
            piece = 1.5 * piece if held else max(0.8 * piece, smallest)
            if state.high - state.low >= config.resolve_growth * solved or (state.low == 0 and state.high == len(path)):
                _solve(state, graph, odometry, ranges, live, config, (6.0, 3.0))
                solved = state.high - state.low
                if _place(state, ranges, live, config, search):
                    _solve(state, graph, odometry, ranges, live, config, (6.0, 3.0))
    _place_doubtful(state)
    doubtful = np.array([k in state.hypotheses and ambiguous(list(state.hypotheses[k]), search) for k in range(anchors)])
    final = replace(graph, poses=state.poses, anchors=state.anchors, calibration=state.calibration)
    found = tuple(state.hypotheses.get(k, ()) for k in range(anchors))
    return FirstEstimate(final, state.placed, found, doubtful.astype(bool))


def _tag_positions(ranges: RangeEdges, poses: Floats, which: Bools) -> Floats:
    arm = ranges.lever_arm[which] + se2.rotate(ranges.turn[which], ranges.tag)
    return se2.transform(poses[ranges.pose[which]], arm)


@dataclass(frozen=True, slots=True, eq=False)
class _Seed:
    """A stretch [low, high) of dead-reckoned poses and the anchors found from it."""

    worth: float
    found: dict[int, tuple[AnchorHypothesis, ...]]
    low: int
    high: int
    poses: Floats
    calibration: Calibration


def _seed(
    state: _Growing, graph: Graph, odometry: OdometryEdges, ranges: RangeEdges, live: Bools,
    path: Floats, config: GrowthConfig, search: AnchorConfig,
) -> float:
    """Choose the stretch whose anchors are clearest and place them; return its length, m."""
    best: _Seed | None = None
    heard = min(len(np.unique(ranges.anchor[live])), 3)
    lengths = tuple(d for d in config.seed_distances if d < path[-1]) + (float(path[-1]),)
    for heading_scale in config.heading_scales:
        calibration = _with(state.calibration, "heading_scale", heading_scale)
        if calibration is None:
            continue
        poses = _dead_reckon(graph.poses[0], odometry.corrected(replace(graph, calibration=calibration)))
        found = _best_stretch(poses, ranges, live, path, lengths, config, search, heard)
        seed = replace(found, calibration=calibration)
        lengths = lengths[:2] + lengths[-1:]
        if best is None or seed.worth > best.worth * 1.1:
            best = seed
        if best.worth > config.clear_enough * heard:
            break
    assert best is not None
    state.low, state.high, state.poses, state.calibration = best.low, best.high, best.poses, best.calibration
    _adopt(state, best.found, search)
    return float(path[state.high - 1] - path[state.low])


def _with(calibration: Calibration, name: str, value: float) -> Calibration | None:
    """Return the calibration with one value set; None where that is not an unknown and the value is not nominal."""
    index = calibration.index(name)
    if index < 0:
        return calibration if value == 0.0 else None
    values = calibration.values.copy()
    values[index] = value
    return replace(calibration, values=values)


def _dead_reckon(start: Floats, motion: Floats) -> Floats:
    """Chain motions (n-1, 3) from a start pose (3,) into poses (n, 3)."""
    theta = start[2] + np.concatenate([[0.0], np.cumsum(motion[:, 2])])
    steps = se2.rotate(theta[:-1], motion[:, :2])
    xy = start[:2] + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.concatenate([xy, se2.wrap_angle(theta)[:, None]], axis=1)


def _best_stretch(
    poses: Floats, ranges: RangeEdges, live: Bools, path: Floats, lengths: tuple[float, ...],
    config: GrowthConfig, search: AnchorConfig, heard: int,
) -> _Seed:
    """Search the anchors from stretches of several lengths, evenly spaced, and return the clearest."""
    best: _Seed | None = None
    nowhere = np.zeros(int(ranges.anchor.max(initial=-1)) + 1, dtype=bool)
    for length in lengths:
        places = 1 + max(0, min(5, int(2 * path[-1] / max(length, 1e-9)) - 2))
        for start in np.linspace(0.0, path[-1] - length, places):
            low, high = int(np.searchsorted(path, start)), int(np.searchsorted(path, start + length, "right"))
            found = _search_all(poses, nowhere, ranges, live, low, high, config.drift * length, search)
            clear = [h[0] for h in found.values() if h and not ambiguous(list(h), search)]
            worth = sum(1.0 / (1.0 + h.sigma / config.range_sigma + h.position_sigma) for h in clear)
            if best is None or worth > best.worth + 1e-9:
                best = _Seed(worth, found, low, high, poses, Calibration())
        if best is not None and best.worth > config.clear_enough * heard:
            break
    assert best is not None
    return best


def _search_all(
    poses: Floats, placed: Bools, ranges: RangeEdges, live: Bools, low: int, high: int, drift: float, search: AnchorConfig
) -> dict[int, tuple[AnchorHypothesis, ...]]:
    inside = live & (ranges.pose >= low) & (ranges.pose < high)
    found = {}
    for anchor in np.unique(ranges.anchor[inside]):
        if not placed[anchor]:
            which = inside & (ranges.anchor == anchor)
            height = ranges.height[which]
            level = np.sqrt(np.maximum(ranges.ranges[which] ** 2 - height**2, 1e-4))
            found[int(anchor)] = tuple(locate(_tag_positions(ranges, poses, which), level, search, drift))
    return found


def _adopt(state: _Growing, found: dict[int, tuple[AnchorHypothesis, ...]], search: AnchorConfig) -> bool:
    """Place the anchors of which one hypothesis stands out; remember all."""
    any_new = False
    for anchor, hypotheses in found.items():
        if not hypotheses:
            continue
        state.hypotheses[anchor] = hypotheses
        if not ambiguous(list(hypotheses), search):
            _put(state, anchor, hypotheses[0])
            any_new = True
    return any_new


def _put(state: _Growing, anchor: int, hypothesis: AnchorHypothesis) -> None:
    state.anchors[anchor] = hypothesis.position
    state.sigma[anchor] = max(hypothesis.sigma, state.sigma[anchor])
    state.placed[anchor] = True


def _place_doubtful(state: _Growing) -> None:
    """Give ambiguous anchors their best hypothesis; the caller must say so."""
    for anchor, hypotheses in state.hypotheses.items():
        if hypotheses and not state.placed[anchor]:
            _put(state, anchor, hypotheses[0])


def _place(state: _Growing, ranges: RangeEdges, live: Bools, config: GrowthConfig, search: AnchorConfig) -> bool:
    """Search anchors not yet placed from the poses so far."""
    found = _search_all(state.poses, state.placed, ranges, live, state.low, state.high, 2.0 * config.range_sigma, search)
    return _adopt(state, found, search)


def _extend(
    state: _Growing, graph: Graph, odometry: OdometryEdges, ranges: RangeEdges, live: Bools, path: Floats, piece: float
) -> bool:
    """Lay on one piece at each open end by calibrated odometry; tell whether it agreed with the anchors as it was."""
    motion = odometry.corrected(replace(graph, calibration=state.calibration))
    held = True
    if state.high < len(path):
        old, new = state.high, int(np.searchsorted(path, path[state.high - 1] + piece, "right"))
        state.high = max(min(new, len(path)), old + 1)
        for k in range(old, state.high):
            state.poses[k] = se2.compose(state.poses[k - 1], motion[k - 1])
        held &= _settle(state, odometry, ranges, live, old - 1, state.high, old - 1)
    if state.low > 0:
        old, new = state.low, int(np.searchsorted(path, path[state.low] - piece))
        state.low = min(new, old - 1)
        for k in range(old - 1, state.low - 1, -1):
            state.poses[k] = se2.compose(state.poses[k + 1], se2.inverse(motion[k]))
        held &= _settle(state, odometry, ranges, live, state.low, old + 1, old)
    return held


def _settle(
    state: _Growing, odometry: OdometryEdges, ranges: RangeEdges, live: Bools, low: int, high: int, held: int
) -> bool:
    """Optimise the poses of [low, high) with one of them, the anchors and the calibration held.

    Returns True where the ranges agreed with the prediction within three standard deviations; then nothing is moved.
    """
    part = _part(state, odometry, ranges, live, low, high)
    errors = [e.residuals(part) for e in part.edges if isinstance(e, RangeEdges)]
    if not errors or float(np.median(np.abs(errors[0]))) < 2.0:
        return True
    fixed = np.zeros(high - low, dtype=bool)
    fixed[held - low] = True
    part = replace(
        part,
        fixed_poses=fixed,
        fixed_anchors=np.ones(len(state.anchors), dtype=bool),
        fixed_calibration=np.ones(len(state.calibration.values), dtype=bool),
    )
    state.poses[low:high] = _anneal(part, (20.0, 6.0, 3.0)).poses
    return False


def _solve(
    state: _Growing, graph: Graph, odometry: OdometryEdges, ranges: RangeEdges, live: Bools,
    config: GrowthConfig, schedule: tuple[float, ...],
) -> None:
    """Optimise everything known so far."""
    part = _part(state, odometry, ranges, live, state.low, state.high)
    part = replace(part, fixed_anchors=~state.placed, fixed_calibration=graph.fixed_calibration)
    solved = _anneal(part.with_edges(*graph.edges), schedule)
    state.poses[state.low : state.high] = solved.poses
    state.anchors = solved.anchors.copy()
    state.calibration = solved.calibration
    for edges in solved.edges:
        if isinstance(edges, RangeEdges):
            error = np.abs(edges.residuals(solved)[:, 0] * edges.sigma)
            for anchor in np.unique(edges.anchor):
                spread = 1.4826 * float(np.median(error[edges.anchor == anchor]))
                state.sigma[anchor] = max(spread, config.range_sigma)


def _part(state: _Growing, odometry: OdometryEdges, ranges: RangeEdges, live: Bools, low: int, high: int) -> Graph:
    """Return the graph of poses [low, high) with their odometry and their ranges to placed anchors."""
    wheels = replace(
        odometry,
        i=odometry.i[low : high - 1] - low,
        j=odometry.j[low : high - 1] - low,
        motion=odometry.motion[low : high - 1],
        length=odometry.length[low : high - 1],
        duration=odometry.duration[low : high - 1],
        sqrt_information=odometry.sqrt_information[low : high - 1],
        calibration=odometry.calibration[low : high - 1],
    )
    which = live & (ranges.pose >= low) & (ranges.pose < high) & state.placed[ranges.anchor]
    radio = pick_ranges(ranges, which)
    radio = replace(radio, pose=radio.pose - low, sigma=state.sigma[radio.anchor])
    return Graph(state.poses[low:high], state.anchors, (), state.calibration).with_edges(wheels, radio)


def pick_ranges(ranges: RangeEdges, which: Bools | Ints) -> RangeEdges:
    """Return some of the range edges."""
    return replace(
        ranges,
        pose=ranges.pose[which],
        anchor=ranges.anchor[which],
        ranges=ranges.ranges[which],
        sigma=ranges.sigma[which],
        lever_arm=ranges.lever_arm[which],
        turn=ranges.turn[which],
        velocity=ranges.velocity[which],
        height=ranges.height[which],
        stamps=ranges.stamps[which],
        calibration=ranges.calibration[which],
        weights=None if ranges.weights is None else ranges.weights[which],
    )


def _anneal(graph: Graph, schedule: tuple[float, ...]) -> Graph:
    """Optimise with the ranges' kernel tightened step by step (graduated non-convexity)."""
    quick = SolverConfig(max_iterations=15, relative_decrease=1e-4)
    for scale in schedule:
        kernel = Kernel("geman-mcclure", scale)
        edges = tuple(replace(e, kernel=kernel) if isinstance(e, RangeEdges) else e for e in graph.edges)
        graph = optimize(replace(graph, edges=edges), quick)[0]
    return graph
