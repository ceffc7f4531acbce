"""Point-to-line ICP of many pairs of clouds at once, each pair on its own."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .. import se2
from ..arrays import Floats, Ints, concatenated
from .cloud_rasters import CloudRasters
from .clouds import Clouds
from .scan_matching import PairFactors, PairPoints, match, nondegenerate_step


@dataclass(frozen=True, slots=True)
class DescentPolicy:
    """Descent of one pair of clouds."""

    farthest: ClassVar[float] = 0.3
    """Longest step of one iteration, m."""
    widest: ClassVar[float] = 0.15
    """The same in heading, rad."""
    gate_per_step: ClassVar[float] = 10.0
    """Largest ratio of the next gate to a step, the larger of m and rad: points 10 m away move by ten times the angle."""
    converged: ClassVar[float] = 1e-4
    """Steps below this end the descent, m or rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Final relative poses of pairs."""

    pose: Floats
    """(e, 3) T_i_j."""
    factors: PairFactors
    """Of the last matches."""

    @property
    def share(self) -> Floats:
        """Share of the points looked up that found a match (e,), 0..1."""
        return self.factors.matched / np.maximum(self.factors.asked, 1)

    @property
    def rms(self) -> Floats:
        """Root mean square distance of the matches (e,), m."""
        return np.sqrt(self.factors.squared / np.maximum(self.factors.weight, 1e-9))


def align_pairs(
    clouds: Clouds, raster: CloudRasters, i: Ints, guess: Floats, points: PairPoints, first_gate: float, last_gate: float,
    iterations: int = 20,
) -> Aligned:
    """Align many pairs of clouds at once, each on its own: point-to-line ICP with a gate that shrinks with its steps.

    A pair that no longer moves at the last gate is finished.

    Parameters
    ----------
    i : (e,) target clouds. guess : (e, 3) start poses of the source clouds.
    points : of the source clouds, see pair_points. first_gate, last_gate : farthest match in the first and last iteration, m.
    """
    pose, gate, moving = guess.copy(), np.full(len(guess), first_gate), np.arange(len(guess))
    finished: list[tuple[Ints, PairFactors]] = []
    for _ in range(iterations):
        some = PairPoints(points.row[moving])
        factors = match(clouds, raster, i[moving], pose[moving], some, gate, gate / 2.0)
        step = nondegenerate_step(factors)[0]
        length = np.abs(step).max(axis=1)
        reach = np.maximum(np.hypot(step[:, 0], step[:, 1]) / DescentPolicy.farthest, np.abs(step[:, 2]) / DescentPolicy.widest)
        pose[moving] += step / np.maximum(reach, 1.0)[:, None]
        left = (length >= DescentPolicy.converged) | (gate > last_gate)
        if not left.all():
            finished.append((moving[~left], _after(factors.rows(~left), step[~left])))
        gate = np.maximum(np.minimum(0.8 * gate, DescentPolicy.gate_per_step * length), last_gate)[left]
        moving = moving[left]
        if not len(moving):
            break
    if len(moving) or not finished:
        some = PairPoints(points.row[moving])
        finished.append((moving, match(clouds, raster, i[moving], pose[moving], some, last_gate, last_gate / 2.0)))
    pose[:, 2] = se2.wrap_angle(pose[:, 2])
    order = np.argsort(np.concatenate([which for which, _ in finished]))
    return Aligned(pose, concatenated([factors for _, factors in finished]).rows(order))


def _after(factors: PairFactors, step: Floats) -> PairFactors:
    """Return the factors after steps (e, 3) so short that every point keeps its match."""
    change = np.einsum("eij,ej->ei", factors.hessian, step)
    squared = factors.squared + np.einsum("ei,ei->e", 2.0 * factors.gradient + change, step)
    return replace(factors, gradient=factors.gradient + change, squared=squared)
