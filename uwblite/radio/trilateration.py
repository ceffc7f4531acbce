"""Places of anchors by ranges along a path alone, and places of a rigid path by ranges to known points.

The intersection of the circles is searched, not linearised: every cell of a coarse raster is scored by how many
ranges agree with it up to one common bias (their median), so up to almost half of the ranges may be outliers. The best
cells are refined one by one. A straight path leaves two mirrored positions that fit equally well; both are returned.

A rigid path is placed from a circle of headings R: a range d from its point b to a known point a means |a - R b - t| = d;
squared, |p|^2 - 2 p.t + |t|^2 = d^2 with p = a - R b is linear in t and |t|^2. A robust descent follows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from .. import se2
from ..arrays import MAD_TO_SIGMA, MOST, OUTLIER, TINY, Floats, chunks, row_medians
from ..config import setting
from ..sensor_log import LONGEST_RANGE
from .range_noise import USUAL_KERNEL


@dataclass(frozen=True, slots=True)
class TrilaterationConfig:
    """Search for anchor positions."""

    raster: int = setting(40, minimum=2, maximum=400, advanced=True)
    """Cells along the longer side of the searched area."""
    samples: ClassVar[int] = 100
    """Ranges used for the search, spread evenly over the path."""
    min_ranges: int = 8
    """An anchor with fewer usable ranges is not placed."""
    max_range: float = LONGEST_RANGE
    """Longer readings are no ranges of such a radio, m."""
    bias_sigma: float = setting(0.6, above=0.0)
    """Plausible size of one anchor's constant error, m."""
    ambiguity: float = setting(0.2, advanced=True)
    """An anchor is ambiguous where a second hypothesis costs less than this more: of 100 ranges, a likelihood ratio of e^10."""
    starts: ClassVar[int] = 10
    """Cells of the raster, the best first, from which descent starts."""
    apart: ClassVar[float] = 1.5
    """Cells between two starts, and the width of the first kernel."""
    shrinking: ClassVar[float] = 0.7
    """Factor on the kernel from step to step; in cells, the error at which a cell is no place for a range."""
    finest: ClassVar[float] = 0.05
    """m; least width of the kernel."""
    steps: ClassVar[int] = 25
    still: ClassVar[float] = 1e-3
    """Most steps of descent, and m of one that ends it; also the damping, as a share of the information."""


_AT_ONCE = 8
"""Stretches searched together; more do not fit into the processor's cache."""


@dataclass(frozen=True, slots=True, eq=False)
class AnchorHypothesis:
    """One possible place of an anchor."""

    position: Floats
    """(2,) m, frame of the path."""
    bias: float
    """m."""
    sigma: float
    """Robust standard deviation of the ranges about it, m."""
    cost: float
    """Mean truncated squared residual, in units of the best hypothesis' variance; 0 perfect, OUTLIER^2 hopeless."""
    position_sigma: float
    """Larger standard deviation of the position were the errors independent, m."""


def trilaterate(path: Floats, ranges: Floats, config: TrilaterationConfig, drift: float = 0.0) -> list[AnchorHypothesis]:
    """Find the possible places of an anchor.

    Parameters
    ----------
    path : (m, 2) positions of the tag at the ranges, m.
    ranges : (m,) m, usable ones.
    drift : expected error of the path within this stretch, m; a lower bound of the ranges' standard deviation.

    Returns
    -------
    Hypotheses, best first; empty where there are fewer than min_ranges ranges.
    """
    return trilaterate_each([(path, ranges)], config, drift)[0]


def trilaterate_each(
    stretches: Sequence[tuple[Floats, Floats]], config: TrilaterationConfig, drift: float = 0.0
) -> list[list[AnchorHypothesis]]:
    """Find the same for several stretches of ranges, each with path and ranges as above, in a third of the time."""
    found: list[list[AnchorHypothesis]] = [[] for _ in stretches]
    of_size: dict[int, list[int]] = {}
    for k, (_, ranges) in enumerate(stretches):
        if len(ranges) >= config.min_ranges:
            of_size.setdefault(min(len(ranges), config.samples), []).append(k)
    for own in of_size.values():
        for some in (own[part] for part in chunks(len(own), _AT_ONCE)):
            for k, hypotheses in zip(some, _of_one_size([stretches[k] for k in some], config, drift), strict=True):
                found[k] = hypotheses
    return found


def ambiguous(hypotheses: Sequence[AnchorHypothesis], config: TrilaterationConfig) -> bool:
    """Return whether the second hypothesis explains the ranges about as well as the first."""
    return len(hypotheses) > 1 and hypotheses[1].cost - hypotheses[0].cost < config.ambiguity


def _of_one_size(
    stretches: Sequence[tuple[Floats, Floats]], config: TrilaterationConfig, drift: float
) -> Iterator[list[AnchorHypothesis]]:
    """Yield the hypotheses of stretches of which equally many ranges are used."""
    picks = [np.unique(np.linspace(0, len(ranges) - 1, config.samples).astype(np.intp)) for _, ranges in stretches]
    picked = [(path[pick], ranges[pick]) for (path, ranges), pick in zip(stretches, picks, strict=True)]
    searched = [_raster_search(path, ranges, config) for path, ranges in picked]
    starts = [_starts(*found) for found in searched]
    each = np.repeat(np.arange(len(starts)), [len(s) for s in starts])
    steps = np.array([step for _, _, step in searched])[each]
    paths, ranges = (np.stack(columns) for columns in zip(*picked, strict=True))
    refined = _refine(paths[each], ranges[each], np.concatenate(starts), steps, drift, config)
    for k, (path, own) in enumerate(picked):
        own_refined = tuple(values[each == k] for values in refined)
        floor = max(float(own_refined[2].min()), 0.5 * drift, 0.5 * config.finest)
        apart, distinct = max(OUTLIER * floor, 0.5 * searched[k][2]), list[AnchorHypothesis]()
        for hypothesis in _scored(path, own, own_refined, floor, config):
            if all(np.hypot(*(hypothesis.position - other.position)) > apart for other in distinct):
                distinct.append(hypothesis)
        yield distinct


def _raster_search(path: Floats, ranges: Floats, config: TrilaterationConfig) -> tuple[Floats, Floats, float]:
    """Return the best raster cells (s, 2), the best bias (s,) of each, and the cell size, m."""
    reach = float(np.quantile(ranges, MOST)) + config.bias_sigma
    low, high = path.min(axis=0) - reach, path.max(axis=0) + reach
    step = float(np.max(high - low)) / config.raster
    axes = [np.arange(low[k] + step / 2, high[k] + step / 2, step) for k in (0, 1)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    # Single precision is enough to choose cells, and takes half the time.
    across, along = (((axis[:, None] - place) ** 2).astype(np.float32) for axis, place in zip(axes, path.T, strict=True))
    error = ranges.astype(np.float32) - np.sqrt(across[:, None] + along).reshape(len(cells), -1)
    bias = np.clip(row_medians(error), -config.bias_sigma - step, OUTLIER * config.bias_sigma + step)
    error -= bias[:, None]
    error /= config.shrinking * step
    cost = np.minimum(np.square(error, out=error), 1.0, out=error).mean(axis=1)
    cost += _OF_BIAS * (bias / (config.bias_sigma + step)) ** 2
    likely = np.argsort(cost, kind="stable")
    best, free = list[int](), np.ones(len(likely), dtype=bool)
    while len(best) < config.starts and free.any():
        best.append(int(likely[np.argmax(free)]))
        free &= np.abs(cells[likely] - cells[best[-1]]).max(axis=1) > config.apart * step
    return cells[best], bias[best], step


_OF_BIAS = 0.05
"""Cost of a cell of a bias of its standard deviation, in false ranges."""


def _starts(cells: Floats, bias: Floats, step: float) -> Floats:
    """Return the starts (s, 3) of descent: each cell with no bias, and with its best bias where descent does not find it."""
    plain, biased = np.column_stack([cells, np.zeros(len(cells))]), np.column_stack([cells, bias])
    return np.concatenate([plain, biased[np.abs(bias) > 0.5 * step]])


def _refine(
    paths: Floats, ranges: Floats, starts: Floats, steps: Floats, drift: float, config: TrilaterationConfig
) -> tuple[Floats, Floats, Floats]:
    """Refine starts (s, 3) by Gauss-Newton with a shrinking kernel, each with its own path (s, m, 2), ranges (s, m) and cell of
    the raster (s,), m.

    Returns position and bias (s, 3), their covariances (s, 3, 3) for unit sigma, and robust sigmas (s,).
    """
    eye, state, on = np.eye(starts.shape[1]), starts.copy(), np.arange(len(starts))
    x, y = np.ascontiguousarray(paths[:, :, 0]), np.ascontiguousarray(paths[:, :, 1])
    scale, normal, robust = config.apart * steps, np.tile(eye, (len(starts), 1, 1)), np.zeros(len(starts))
    for _ in range(config.steps):
        here, width = state[on], scale[on]
        dx, dy = here[:, :1] - x, here[:, 1:2] - y
        distance = np.maximum(np.sqrt(dx * dx + dy * dy), TINY)
        rows = np.stack([dx / distance, dy / distance, np.ones_like(dx), ranges - distance - here[:, 2:]], axis=1)
        error = rows[:, -1]
        weight = 1.0 / np.square(1.0 + np.square(error / width[:, None]))
        products = (rows[:, :-1] * weight[:, None]) @ rows.transpose(0, 2, 1)
        equations, gradient = products[:, :, :-1], products[:, :, -1]
        robust[on] = sigma = MAD_TO_SIGMA * row_medians(np.abs(error))
        prior = (np.clip(sigma, drift, width) / config.bias_sigma) ** 2
        equations[:, 2, 2] += prior
        gradient[:, 2] -= prior * here[:, 2]
        equations += config.still * equations * eye + TINY * eye
        delta = np.linalg.solve(equations, gradient[:, :, None])[:, :, 0]
        farthest = 2.0 * steps[on] / np.maximum(np.hypot(delta[:, 0], delta[:, 1]), TINY)
        state[on] = here + delta * np.minimum(1.0, farthest)[:, None]
        normal[on] = equations
        tight = np.maximum(2.0 * sigma, max(drift, config.finest))
        going = (width > 1.01 * tight) | (np.abs(delta).max(axis=1) >= config.still)
        scale[on] = np.maximum(config.shrinking * width, tight)
        if not going.any():
            break
        on, x, y, ranges = on[going], x[going], y[going], ranges[going]
    return state, np.asarray(np.linalg.inv(normal), dtype=np.float64), np.maximum(robust, config.still)


def _scored(
    path: Floats, ranges: Floats, refined: tuple[Floats, ...], sigma: float, config: TrilaterationConfig
) -> list[AnchorHypothesis]:
    """Return the hypotheses of states, covariances and robust sigmas as of _refine, best first; sigma: of the best, m."""
    states, covariances, own = refined
    offset, bias = states[:, :2, None] - path.T, states[:, 2]
    error = ranges - np.hypot(offset[:, 0], offset[:, 1]) - bias[:, None]
    cost = np.minimum((error / sigma) ** 2, OUTLIER**2).mean(axis=1) + (bias / config.bias_sigma) ** 2 / len(ranges)
    spread = own * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1], 0.0))
    order = np.argsort(cost, kind="stable").tolist()
    return [AnchorHypothesis(states[k, :2], float(bias[k]), float(own[k]), float(cost[k]), float(spread[k])) for k in order]


class PathPlacement(NamedTuple):
    """A place of a rigid path."""

    cost: float
    """Half the robust sum of squares of whitened errors and of the prior."""
    motion: Floats
    """(3,) T_points_path."""
    information: Floats
    """(3, 3) of the motion, of errors and prior."""


_HEADINGS = 12
"""Starts of the heading."""


def path_placements(
    points: Floats, tags: Floats, ranges: Floats, roots: Floats, size: float = np.inf
) -> list[PathPlacement]:
    """Return the places of a rigid path, one from each of some headings, the best first.

    Parameters
    ----------
    points : (m, 2) known ones, m. tags : (m, 2) the tag in the path's frame, m. ranges : (m,) between them, m.
    roots : (m,) square roots of the ranges' information, 1/m. size : prior standard deviation of the motion, m and rad.
    """

    def errors(motion: Floats) -> Floats:
        distance = np.hypot(*(se2.transform(motion, tags) - points).T)
        return np.append(roots * (distance - ranges), motion / size)

    def slopes(motion: Floats) -> Floats:
        tag = se2.transform(motion, tags)
        away, arm = tag - points, tag - motion[:2]
        direction = away / np.maximum(np.hypot(*away.T), TINY)[:, None]
        turn = direction[:, 1] * arm[:, 0] - direction[:, 0] * arm[:, 1]
        return np.vstack([roots[:, None] * np.column_stack([direction, turn]), np.eye(3) / size])

    found = list[PathPlacement]()
    for heading in np.linspace(0.0, 2.0 * np.pi, _HEADINGS, endpoint=False):
        away = points - se2.rotate(np.full(len(tags), heading), tags)
        rows = roots[:, None] * np.column_stack([-2.0 * away, np.ones(len(away))])
        place = np.linalg.lstsq(rows, roots * (ranges**2 - np.sum(away**2, axis=1)), rcond=None)[0][:2]
        start = np.append(place, se2.wrap_angle(heading))
        done = least_squares(errors, start, jac=slopes, loss="cauchy", f_scale=USUAL_KERNEL.scale)
        motion = np.append(done.x[:2], se2.wrap_angle(done.x[2]))
        found.append(PathPlacement(float(done.cost), motion, done.jac.T @ done.jac))
    return sorted(found, key=lambda each: each.cost)
