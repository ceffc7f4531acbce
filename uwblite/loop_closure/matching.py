"""Matching of candidates for loop closures: correlative search, alignment, comparison with each other's free space.

Candidates are matched in batches, each with the sub-maps it needs: by one process or by several, with the same result.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, Table, concatenated
from ..graph.work import Work
from ..lidar.cloud_rasters import rasterize
from ..lidar.clouds import CloudConfig, Clouds
from ..lidar.correlative_matching import CorrelativeConfig, search
from ..lidar.scan_matching import Aligned, PairPolicy, align_pairs, match, pairs_of
from ..lidar.submaps import Submaps
from ..lidar.visibility import FreeSpace, net_overlap, violates_free_space
from .candidates import CandidatePolicy, Candidates
from .closures import LoopClosureConfig
from .parallel import batches, in_order


class MatchingPolicy:
    """Search for the places of candidates."""

    least_turn: float = 0.1
    """Least half-width of a search, rad."""
    many_places: int = 20
    """Places found by a wide search that are matched before one is chosen: along a corridor the walls fit at many places."""
    same_place: float = 0.3
    """Matches nearer to each other than this, m and rad, are one place."""
    finer: float = 1.5
    """Factor by which the headings of a wide search are closer."""
    extent: float = 0.95
    """Share of the points of a cloud that its extent contains: those that are far are few."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosureMatches(Table):
    """How candidates (c,) fit."""

    best: Aligned
    """The guess where no place was found."""
    found: Bools
    """A place was found."""
    second: Floats
    """Ratio of the matches at the second-best place to those at the best."""
    through: Floats
    """Share of its points that would stand in free space."""
    net: Floats
    """m, net matching surface, see net_overlap; inf where no wide search was made."""


@dataclass(frozen=True, slots=True, eq=False)
class _Batch:
    """Some candidates, by the numbers of the sub-maps of the batch."""

    candidates: Candidates
    clouds: Clouds
    spacing: float
    free: Sequence[FreeSpace] | None
    config: LoopClosureConfig
    search: CorrelativeConfig


def fit(
    candidates: Candidates, submaps: Submaps, config: LoopClosureConfig, search_config: CorrelativeConfig,
    free: Sequence[FreeSpace] | None = None, progress: Callable[[int, int], None] | None = None,
    executor: Executor | None = None,
) -> ClosureMatches:
    """Find where each candidate fits.

    Parameters
    ----------
    free : observed free space of each sub-map; None = not tested.
    """
    tasks = (
        _Batch(
            replace(candidates.rows(rows), target=target, source=source), replace(submaps.clouds.chosen(used), work=Work()),
            submaps.spacing, None if free is None else [free[k] for k in used.tolist()], config, search_config,
        )
        for rows, used, target, source in batches(candidates.target, candidates.source)
    )
    done, parts = 0, []
    for part, spent in in_order(_fit, tasks, executor):
        parts.append(part)
        submaps.clouds.work.update(spent)
        done += len(part.found)
        if progress is not None:
            progress(done, len(candidates.target))
    return concatenated(parts)


def _fit(batch: _Batch) -> tuple[ClosureMatches, Work]:
    """Fit one batch, and return the work of that; runs in a worker."""
    candidates, clouds, config = batch.candidates, batch.clouds, batch.config
    gate = config.gate
    raster = rasterize(clouds, CloudConfig.raster, PairPolicy.reach)
    row, guess = _guesses(batch)
    target, source = candidates.target[row], candidates.source[row]
    tries = align_pairs(raster, pairs_of(clouds, target, source, config.points), guess, PairPolicy.reach, gate)
    score = tries.share
    if candidates.long:
        score = batch.spacing * net_overlap(raster, batch.free, target, source, tries.pose, gate)
    place, second = _best_places(row, tries.pose, score, len(candidates.target))
    found, pose = place >= 0, candidates.guess.copy()
    net = np.full(len(place), np.inf)
    if candidates.long:
        net[found] = score[place[found]]
    pose[found] = tries.pose[place[found]]
    pairs = pairs_of(clouds, candidates.target, candidates.source, config.points)
    factors = match(raster, pairs, pose, gate, gate / 2.0)
    best = Aligned(pose, factors)
    through = _free_space_violations(batch, best, _promising(best, net, config))
    return ClosureMatches(best, found, second, through, net), clouds.work


def _guesses(batch: _Batch) -> tuple[Ints, Floats]:
    """Return places to start matching from: candidate (g,) and pose (g, 3); several for those that are searched for."""
    candidates, config = batch.candidates, batch.config
    rows, guesses = [], []
    chosen = cache(lambda k: batch.clouds.chosen(np.array([k])))
    for k, searched in enumerate((candidates.spread > config.direct).tolist()):
        poses = candidates.guess[k : k + 1]
        if searched:
            search_config, places = batch.search, config.places
            if candidates.long:
                search_config, places = _coarse(batch.search), MatchingPolicy.many_places
            turn = CandidatePolicy.sigmas * np.sqrt(candidates.covariance[k, 2, 2])
            turn = float(np.clip(turn, MatchingPolicy.least_turn, config.search_angle))
            target, source = (chosen(int(of[k])) for of in (candidates.target, candidates.source))
            centre, half_widths = _window(poses[0], float(candidates.spread[k]), turn, target, source)
            poses = search(target, source, centre, half_widths, search_config)[:places]
        rows.append(np.full(len(poses), k))
        guesses.append(poses)
    return np.concatenate(rows).astype(np.intp), np.concatenate(guesses)


def _window(
    guess: Floats, half_width: float, turn: float, target: Clouds, source: Clouds
) -> tuple[Floats, tuple[float, float, float]]:
    """Return centre (3,) and half-widths of the poses within a half-width of a guess, m, at which two clouds overlap."""
    ends = guess[:2] + half_width * np.array([[-1.0], [1.0]])
    if len(target.points) and len(source.points):
        most = MatchingPolicy.extent
        reach = np.quantile(np.hypot(*source.points.T), most)
        inside = np.quantile(target.points, [1.0 - most, most], axis=0) + reach * np.array([[-1.0], [1.0]])
        ends = np.clip(inside, *ends)
    low, high = ends
    (x, y), (wide, tall) = 0.5 * (low + high), 0.5 * (high - low)
    return np.array([x, y, guess[2]]), (float(wide), float(tall), turn)


def _coarse(config: CorrelativeConfig) -> CorrelativeConfig:
    """Return the settings of a wide search: larger cells, finer headings for long clouds, and many places."""
    return replace(
        config, resolution=2.0 * config.resolution, spread=2.0 * config.spread,
        angle_step=config.angle_step / MatchingPolicy.finer, candidates=MatchingPolicy.many_places,
    )


def _best_places(row: Ints, pose: Floats, share: Floats, candidates: int) -> tuple[Ints, Floats]:
    """Return the best try of each candidate (c,), -1 = none, and what share of its matches another place reaches (c,).

    Parameters
    ----------
    row : (g,) candidate of each try. pose : (g, 3). share : (g,) that matches.
    """
    best, second = np.full(candidates, -1, dtype=np.intp), np.zeros(candidates)
    order = np.lexsort((-share, row))
    tried, first = np.unique(row[order], return_index=True)
    best[tried] = order[first]
    apart = se2.between(pose[best[row]], pose)
    other = (np.hypot(apart[:, 0], apart[:, 1]) > MatchingPolicy.same_place) | (np.abs(apart[:, 2]) > MatchingPolicy.same_place)
    np.maximum.at(second, row[other], share[other])
    second[tried] /= np.maximum(share[best[tried]], np.finfo(np.float64).tiny)
    return best, second


def _promising(best: Aligned, net: Floats, config: LoopClosureConfig) -> Bools:
    """Return which matches (c,), with net overlaps (c,), have enough points and small distances."""
    enough = best.share >= min(config.overlap, config.overlap_after_search)
    return np.asarray(np.where(np.isfinite(net), net >= config.net_overlap, enough) & (best.rms <= config.sigma))


def _free_space_violations(batch: _Batch, best: Aligned, promising: Bools) -> Floats:
    """Return the larger share of points (c,) of either sub-map that would stand in observed free space of the other.

    0 for those that are not promising (c,) and will be rejected anyway.
    """
    candidates, free = batch.candidates, batch.free
    through = np.zeros(len(candidates.target))
    if free is None:
        return through
    for k in np.flatnonzero(promising):
        a, b = int(candidates.target[k]), int(candidates.source[k])
        through[k] = violates_free_space(free[a], batch.clouds.cloud(a)[0], free[b], batch.clouds.cloud(b)[0], best.pose[k])
    return through
