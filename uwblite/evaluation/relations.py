"""How far relative poses of a trajectory are from given ones: the metric of Kuemmerle et al. 2009.

Relations of neighbouring scans show local accuracy, those between visits to one place judge the map as a whole, and no
alignment of frames is needed. The error is the translation and the rotation of d*^-1 d; each relation counts once.

(R. Kuemmerle, B. Steder, C. Dornhege, M. Ruhnke, G. Grisetti, C. Stachniss, A. Kleiner: On measuring the accuracy of SLAM
algorithms, Autonomous Robots 27, 2009; the errors are not squared, as in the tables there.)
"""

from dataclasses import dataclass

import numpy as np

from .. import se2
from ..arrays import Bools, Floats
from ..errors import DataError
from .trajectory import EDGE, ErrorStatistics, covered, statistics

FAR = 0.5
"""Translational error from which a relation is grossly wrong, m."""
_LONGEST_GAP = 10.0
"""Time between poses of the trajectory over which a relation is not answered, s."""


Relations = tuple[Floats, Floats, Floats]
"""Stamps (r,), s, on the lidar's clock, of scans and of others that are seen from them, and poses T_first_second (r, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class RelationErrors:
    """A trajectory against relations."""

    translation: Floats
    """(m,) m, of the relations that the trajectory answers."""
    rotation: Floats
    """(m,) rad."""
    answered: Bools
    """(r,) whether there are poses at both stamps."""
    translations: ErrorStatistics
    rotations: ErrorStatistics
    far: float
    """Share of all relations whose translational error exceeds 0.5 m, or which are not answered."""


def evaluate_relations(stamps: Floats, poses: Floats, relations: Relations, delay: float = 0.0) -> RelationErrors:
    """Compare the relative poses of a trajectory with given ones.

    Parameters
    ----------
    stamps, poses : (n,) s, non-decreasing, and (n, 3) T_map_base.
    delay : s, offset of the lidar's clock: a scan stamped t was taken at t + delay by the clock of the trajectory.

    Raises
    ------
    DataError : the trajectory answers none of them.
    """
    first, second, T_first_second = relations[0] + delay, relations[1] + delay, relations[2]
    # The trajectory's ends may be overhung by the offset of the clock.
    answered = np.logical_and(*(covered(stamps, at, _LONGEST_GAP, abs(delay) + EDGE) for at in (first, second)))
    if not answered.any():
        raise DataError(
            f"the trajectory ({stamps[0]:.3f} .. {stamps[-1]:.3f} s) answers none of the {len(answered)} relations"
            f" (from {min(first.min(), second.min()) - delay:.3f} s on): are both of the same recording?"
        )
    start, end = (se2.interpolate_trajectory(stamps, poses, at[answered]) for at in (first, second))
    error = se2.between(T_first_second[answered], se2.between(start, end))
    translation, rotation = np.hypot(error[:, 0], error[:, 1]), np.abs(se2.wrap_angle(error[:, 2]))
    far = float((np.sum(translation > FAR) + np.sum(~answered)) / len(answered))
    return RelationErrors(translation, rotation, answered, statistics(translation), statistics(rotation), far)
