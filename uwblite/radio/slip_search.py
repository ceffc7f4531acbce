"""Search for a slip of the wheels in a part of the path, by ranges to anchors that have a place.

While wheels slip they count a motion that the robot does not make: from there on the path is displaced as a whole. So of all
moments of a slip, and motions over it, those are sought along which the ranges afterwards are the likeliest.
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import OUTLIER, Floats, Ints, Table, best_run
from ..graph.robust import Kernel
from ..odometry.slips import EVERY, LASTS, SPEED
from ..problem.alternatives import EvidencePolicy


class SlipSearchPolicy:
    """What is tried, and how ranges count."""

    headings: int = 72
    """Turns over a slip, evenly from none to a whole one."""
    shares: tuple[float, ...] = (0.0, 0.5, 1.0)
    """Shares of the distance counted over it that were driven."""
    longest: float = 2.0
    """Time over which the motion is sought, in mean durations of a slip: six in seven are shorter."""
    stride: float = 0.5
    """Time between moments that are tried, in mean durations of a slip."""
    kernel: Kernel = Kernel("geman-mcclure", OUTLIER)
    """Of ranges, in standard deviations."""
    bursts: int = 3
    """Runs of ranges at a time at which a slip is tried."""


@dataclass(frozen=True, slots=True, eq=False)
class TagRanges(Table):
    """Ranges to anchors that have a place."""

    pose: Ints
    """(m,) number of the pose before each."""
    tag: Floats
    """(m, 2) the tag in the frame of that pose, m."""
    place: Floats
    """(m, 2) of the anchor, m."""
    distance: Floats
    """(m,) in the plane, m."""
    sigma: Floats
    """(m,) m."""

    def cost(self, tag: Floats, place: Floats) -> Floats:
        """Return the robust cost (..., m) of the ranges for tags (..., m, 2) and anchors (m, 2) in one frame."""
        error = (np.hypot(tag[..., 0] - place[:, 0], tag[..., 1] - place[:, 1]) - self.distance) / self.sigma
        return SlipSearchPolicy.kernel.rho(error**2)


@dataclass(frozen=True, slots=True, eq=False)
class Slip:
    """A slip of the wheels."""

    first: int
    """Pose at which it begins."""
    last: int
    """Pose at which it has ended."""
    poses: Floats
    """(n, 3) of the part, those after it displaced."""


def likeliest_slip(poses: Floats, duration: Floats, ranges: TagRanges) -> Slip | None:
    """Return the slip along which the ranges are the likeliest; None where none are behind any.

    Parameters
    ----------
    poses : (n, 3) of a part along the wheels, from the end at which they are known on. duration : (n - 1,) of each step, s.
    """
    time, best, slip = np.append(0.0, np.cumsum(duration)), np.inf, None
    usual = ranges.cost(se2.transform(poses[ranges.pose], ranges.tag), ranges.place)
    for moment in np.arange(0.0, time[-1], SlipSearchPolicy.stride * LASTS).tolist():
        first = int(np.searchsorted(time, moment, "right")) - 1
        last = max(int(np.searchsorted(time, moment + SlipSearchPolicy.longest * LASTS)), first + 1)
        after, within = ranges.rows(ranges.pose >= last), ranges.rows((ranges.pose > first) & (ranges.pose < last))
        if last >= len(poses) or not len(after.pose):
            break
        motions = _motions(se2.between(poses[first], poses[last]))
        tag = se2.transform(se2.between(poses[last], poses[after.pose]), after.tag)
        place = se2.transform(se2.inverse(poses[first]), after.place)
        cost = after.cost(se2.transform(motions[:, None], tag), place).sum(axis=1) + usual[ranges.pose <= first].sum()
        # The tag stays about where it was before the slip.
        cost += within.cost(poses[first, :2], within.place).sum()
        k = int(np.argmin(cost))
        if cost[k] < best:
            best, slip = float(cost[k]), Slip(first, last, _displaced(poses, first, last, motions[k]))
    return slip


def bursts(pose: Ints, errors: Floats, density: Floats, shares: Floats) -> list[tuple[int, int]]:
    """Return first and last pose of each run of ranges, the likeliest first, that the tag elsewhere, by as much as slips
    displace it, explains better than their errors.

    Parameters
    ----------
    pose, errors : (m,) of each range, m. density : (m,) logarithm of the density of such an error, 1/m. shares : (m,) of each
        range that is independent of others.
    """
    order, found, elsewhere = np.argsort(pose, kind="stable"), list[tuple[int, int]](), SPEED * LASTS
    displaced = -0.5 * (errors / elsewhere) ** 2 - np.log(np.sqrt(2.0 * np.pi) * elsewhere)
    gain, pose = (shares * (displaced - density))[order], pose[order]
    apart = -float(np.abs(gain).sum())
    while len(found) < SlipSearchPolicy.bursts:
        first, last = best_run(gain)
        if gain[first:last].sum() < EvidencePolicy.positive:
            break
        found.append((int(pose[first]), int(pose[last - 1])))
        gain[first:last] = apart
    return found


def log_prior(duration: float, ranges: float) -> float:
    """Return the logarithm of the prior probability of a slip within a time, s, whose motion so many ranges tell (Schwarz)."""
    return float(np.log(min(max(duration, LASTS) / EVERY, 1.0)) - 1.5 * np.log(max(ranges, 1.0)))


def _motions(counted: Floats) -> Floats:
    """Return motions (h, 3) of the robot over a slip over which the wheels counted one (3,)."""
    turns = np.linspace(-np.pi, np.pi, SlipSearchPolicy.headings, endpoint=False) + counted[2]
    share, turn = (each.ravel() for each in np.meshgrid(SlipSearchPolicy.shares, turns, indexing="ij"))
    return np.column_stack([share[:, None] * counted[:2], turn])


def _displaced(poses: Floats, first: int, last: int, motion: Floats) -> Floats:
    """Return the poses (n, 3) with another motion (3,) between two of them."""
    moved, end = poses.copy(), se2.compose(poses[first], motion)
    moved[last:] = se2.compose(end, se2.between(poses[last], poses[last:]))
    share = np.arange(1, last - first) / (last - first)
    moved[first + 1 : last] = se2.interpolate(poses[first], end, share)
    return moved
