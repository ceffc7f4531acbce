"""Relations between scans, as the SLAM benchmark of Kuemmerle et al. has them: ``stamp1 stamp2 x y z roll pitch yaw``."""

import os

from ..arrays import Floats
from .tum import read_rows

_COLUMNS = "stamp1 stamp2 x y z roll pitch yaw"


def read_relations(path: str | os.PathLike[str]) -> tuple[Floats, Floats, Floats]:
    """Read relations; height, roll and pitch are dropped.

    Parameters
    ----------
    path : the file, plain or gzip; ``-`` = standard input. Blank lines and lines beginning with ``#`` are skipped.

    Returns
    -------
    stamp1, stamp2 : (r,) s. T_1_2 : (r, 3) pose of the second scan as seen from the first; m, m, rad.

    Raises
    ------
    FormatError : a line has not eight finite numbers, or there is no relation.
    """
    table = read_rows(path, _COLUMNS, "relations")
    return table[:, 0].copy(), table[:, 1].copy(), table[:, [2, 3, 7]].copy()
