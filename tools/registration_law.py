"""The law of registration: of placements that are called right with probability p, a share p is right.

Pairs of clouds of one recording are registered with priors drawn about their true relative poses: most within the noise of the
wheels, some where these slipped. Each placement has a probability; the truth says whether it is right. Clouds that show nothing
of each other there are not placed: the prior stands.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from trials import table

from uwblite import se2
from uwblite.lidar.cloud_rasters import rasterize
from uwblite.lidar.clouds import Clouds
from uwblite.lidar.object_likelihood import ObjectLikelihood
from uwblite.lidar.registration import Gaussian, Placed, Placement, Prior, RegistrationConfig, register
from uwblite.lidar.scan_matching import PairPolicy, align_pairs, pairs_of

Floats = NDArray[np.float64]

SOUND, SLIPPED = np.array([0.02, 0.01, 0.02]), np.array([0.5, 0.5, 0.4])
"""Standard deviations of the priors' means about the truth where wheels are sound, and where they slipped, m, m, rad."""
SLIPS = 0.2
"""Share of the pairs whose wheels slipped."""
BINS = (0.0, 0.5, 0.9, 0.99, 1.0)
"""Limits of the probabilities that are summed up."""
CHI2 = 16.27
"""Squared Mahalanobis distance from the truth up to which a placement is right: one in a thousand exceeds it by chance."""


@dataclass(frozen=True)
class Placements:
    """Placements of pairs (e,)."""

    probability: Floats
    """(e,) of being right."""
    right: NDArray[np.bool_]
    """(e,)."""
    unplaced: int
    """Number of pairs that show nothing of each other."""

    def lines(self, name: str) -> list[list[object]]:
        """Return for each bin: the name, the bin, pairs, mean probability and the share that is right."""
        of = np.clip(np.searchsorted(BINS, self.probability, "right") - 1, 0, len(BINS) - 2)
        own = [(f"{BINS[k]:g} to {BINS[k + 1]:g}", of == k) for k in range(len(BINS) - 1) if np.any(of == k)]
        return [[name, label, int(s.sum()), self.probability[s].mean(), self.right[s].mean()] for label, s in own]

    @property
    def log_score(self) -> float:
        """Mean logarithm of the probability of what is the case; 0 is perfect, log(1/2) that of a coin."""
        p = np.clip(np.where(self.right, self.probability, 1.0 - self.probability), 1e-9, 1.0)
        return float(np.log(p).mean())


def placements(clouds: Clouds, truth: Floats, apart: int, rng: np.random.Generator, error: float) -> Placements:
    """Register clouds, which lie at true poses (k, 3), with those some clouds later.

    Parameters
    ----------
    apart : number of clouds between the two of a pair. error : standard deviation of a true relative pose, m and rad.
    """
    i = np.arange(len(clouds) - apart)
    step = se2.between(truth[i], truth[i + apart])
    slips = rng.random(len(i)) < SLIPS
    mean = step + rng.standard_normal(step.shape) * (SOUND + slips[:, None] * SLIPPED)
    sound = np.broadcast_to(np.diag(SOUND**2), (len(i), 3, 3)).copy()
    pairs = pairs_of(clouds, i, i + apart)
    objects = ObjectLikelihood.of(rasterize(clouds, 0.1, 0.5), 0.02, pairs, step)
    ended = align_pairs(objects.raster, pairs, mean, PairPolicy.reach, PairPolicy.gate).pose
    objects = objects.learnt(pairs, ended)
    wide = np.broadcast_to(SLIPPED, mean.shape)
    prior = Prior.about(mean, sound, wide, wide)
    placed, spread, probability = likelier_places(register(objects, pairs, prior, ended), SLIPS)
    off = se2.between(step, placed.pose)
    squared = np.einsum("ei,ei->e", off, np.linalg.solve(spread + error**2 * np.eye(3), off[:, :, None])[:, :, 0])
    return Placements(probability[placed.shown], squared[placed.shown] < CHI2, int(np.sum(~placed.shown)))


def likelier_places(found: Placement, slips: float) -> tuple[Placed, Floats, Floats]:
    """Return the likelier place (e) of each pair, sound or slipped with a probability beforehand, its covariance (e, 3, 3) and
    probability (e,)."""
    prior, useless = found.prior, RegistrationConfig.useless
    (sound, usual), (slipped, wide) = (found.likeliest(part) for part in (prior.sound, prior.slipped))
    of_sound, of_slip = np.log1p(-slips) + usual, np.log(slips) + wide
    every = np.logaddexp(np.logaddexp(of_sound, of_slip), np.log(useless / (1.0 - useless)))
    narrow, broad = covariance(sound, prior.sound), covariance(slipped, prior.slipped)
    off, slid = slipped.pose - sound.pose, of_slip > of_sound
    off[:, 2] = se2.wrap_angle(off[:, 2])
    spread = np.linalg.solve(narrow, broad + off[:, :, None] * off[:, None, :])
    same = np.einsum("eii->e", spread) < RegistrationConfig.contradicts
    likely = np.where(same, np.logaddexp(of_sound, of_slip), np.maximum(of_sound, of_slip)) - every
    place = sound.replaced(np.arange(len(same)), slipped, slid)
    # Any of them may be favoured falsely, however much.
    return place, np.where(slid[:, None, None], broad, narrow), (1.0 - useless) * np.exp(likely)


def covariance(placed: Placed, prior: Gaussian) -> Floats:
    """Return the covariance (e, 3, 3) of the poses by matches and prior."""
    return np.linalg.inv(placed.information + np.linalg.inv(prior.covariance))


def report(rows: list[tuple[str, Placements]]) -> str:
    """Return the calibration curve of recordings by name, of all together, and the log scores."""
    parts = (np.concatenate([getattr(p, name) for _, p in rows]) for name in ("probability", "right"))
    every = Placements(*parts, sum(p.unplaced for _, p in rows))
    lines = [line for name, each in [*rows, ("all", every)] for line in each.lines(name)]
    scores = ", ".join(f"{name} {each.log_score:.3f}" for name, each in [*rows, ("all", every)])
    head = ["recording", "called right with", "pairs", "mean of that", "share right"]
    unplaced = ", ".join(f"{name} {each.unplaced}" for name, each in [*rows, ("all", every)])
    return f"{table(head, lines)}\nPairs that show nothing of each other: {unplaced}.\n\nLog score: {scores}.\n"
