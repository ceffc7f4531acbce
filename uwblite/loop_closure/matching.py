"""Matching of candidates for loop closures: correlative search, alignment, comparison with each other's free space.

Candidates are matched in batches, each with the sub-maps it needs: by one process or by several, with the same result.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Bools, Floats, Ints, concatenated, renumbered
from ..graph.work import Work
from ..lidar.cloud_rasters import rasterize
from ..lidar.clouds import Clouds, make_cloud
from ..lidar.correlative_matching import CorrelativeConfig, search
from ..lidar.overlap import net_overlap
from ..lidar.scan_matching import Aligned, align_pairs, match, pairs_of
from ..lidar.submaps import Submaps
from ..lidar.visibility import FreeSpace, violates_free_space
from .candidates import Candidates
from .closures import LoopClosureConfig
from .parallel import in_order


@dataclass(frozen=True, slots=True)
class MatchingPolicy:
    """Search for the places of candidates."""

    at_once: ClassVar[int] = 32
    """Candidates of a batch."""
    many_places: ClassVar[int] = 20
    """Places found by a wide search that are matched before one is chosen: along a corridor the walls fit at many places."""
    same_place: ClassVar[float] = 0.3
    """Matches nearer to each other than this, m and rad, are one place."""
    extent: ClassVar[float] = 0.95
    """Share of the points of a cloud that its extent contains: those that are far are few."""


@dataclass(frozen=True, slots=True, eq=False)
class ClosureMatches:
    """How candidates (c,) fit."""

    best: Aligned
    """Best match of each; the guess where no place was found."""
    found: Bools
    """(c,) a place was found."""
    second: Floats
    """(c,) ratio of the matches at the second-best place to those at the best."""
    through: Floats
    """(c,) share of its points that would stand in free space."""
    net: Floats
    """(c,) m, net matching surface, see net_overlap; inf where no wide search was made."""


@dataclass(frozen=True, slots=True, eq=False)
class _Batch:
    """Some candidates and all data for matching them."""

    candidates: Candidates
    """Numbers of sub-maps are those of the batch."""
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
    total, done, parts = len(candidates.target), 0, []
    for part, spent in in_order(_fit, _batches(candidates, submaps, config, search_config, free), executor):
        parts.append(part)
        submaps.clouds.work.update(spent)
        done += len(part.found)
        if progress is not None:
            progress(done, total)
    return concatenated(parts)


def _batches(
    candidates: Candidates, submaps: Submaps, config: LoopClosureConfig, search_config: CorrelativeConfig,
    free: Sequence[FreeSpace] | None,
) -> Iterator[_Batch]:
    for first in range(0, len(candidates.target), MatchingPolicy.at_once):
        part = candidates.rows(slice(first, first + MatchingPolicy.at_once))
        used, target, source = renumbered(part.target, part.source)
        spaces = None if free is None else [free[k] for k in used.tolist()]
        clouds = replace(submaps.clouds.chosen(used), work=Work())
        yield _Batch(part.renumbered(target, source), clouds, submaps.spacing, spaces, config, search_config)


def _fit(batch: _Batch) -> tuple[ClosureMatches, Work]:
    """Fit one batch, and return the work of that; runs in a worker."""
    candidates, clouds, config = batch.candidates, batch.clouds, batch.config
    raster = rasterize(clouds, 0.1, 0.5)
    row, guess = _guesses(batch)
    pairs = pairs_of(clouds, candidates.target[row], candidates.source[row], config.points)
    tries = align_pairs(raster, pairs, guess, 0.5, config.gate)
    wide = np.full(len(candidates.target), candidates.long)
    score, some = tries.share, np.flatnonzero(wide[row])
    target, source = candidates.target[row[some]], candidates.source[row[some]]
    poses = tries.pose[some]
    score[some] = batch.spacing * net_overlap(raster, batch.free, target, source, poses, config.gate)
    place, second = _best_places(row, tries.pose, score, len(candidates.target))
    found, pose = place >= 0, candidates.guess.copy()
    net = np.full(len(place), np.inf)
    net[wide & found] = score[place[wide & found]]
    pose[found] = tries.pose[place[found]]
    pairs = pairs_of(clouds, candidates.target, candidates.source, config.points)
    factors = match(raster, pairs, pose, config.gate, config.gate / 2.0)
    best = Aligned(pose, factors)
    through = _free_space_violations(batch, best, _promising(best, net, config))
    return ClosureMatches(best, found, second, through, net), clouds.work


def _guesses(batch: _Batch) -> tuple[Ints, Floats]:
    """Return places to start matching from: candidate (g,) and pose (g, 3); several for those that are searched for."""
    candidates, config = batch.candidates, batch.config
    rows, guesses = [], []
    prepared: dict[int, Clouds] = {}
    for k, searched in enumerate((candidates.spread > config.direct).tolist()):
        poses = candidates.guess[k : k + 1]
        if searched:
            half_width = float(candidates.spread[k])
            search_config, places = batch.search, config.places
            if candidates.long:
                search_config, places = _coarse(batch.search), MatchingPolicy.many_places
            turn = float(np.clip(3.0 * np.sqrt(candidates.covariance[k, 2, 2]), 0.1, config.search_angle))
            target, source = (_prepare(batch.clouds, int(c[k]), prepared) for c in (candidates.target, candidates.source))
            centre, half_widths = _window(poses[0], half_width, turn, target, source)
            poses = search(target, source, centre, half_widths, search_config).poses[:places]
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
    """Return the settings of a wide search: twice the cells, finer headings for long clouds, and many places."""
    twice = replace(config, resolution=2.0 * config.resolution, spread=2.0 * config.spread)
    return replace(twice, angle_step=config.angle_step / 1.5, candidates=MatchingPolicy.many_places)


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
    second[tried] /= np.maximum(share[best[tried]], 1e-9)
    return best, second


def _prepare(clouds: Clouds, k: int, prepared: dict[int, Clouds]) -> Clouds:
    """Return one sub-map's cloud ready for the search; its normals point to the side of the laser."""
    if k not in prepared:
        points, normals = clouds.cloud(k)
        prepared[k] = make_cloud(points, points + normals, work=clouds.work)
    return prepared[k]


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
