"""Trajectories as evo reads them, TUM and KITTI text, and relations between scans."""

import os

import numpy as np

from ..arrays import Floats
from ..errors import FormatError
from .files import write_bytes
from .source import number_table, open_source


def write_tum(path: str | os.PathLike[str], stamps: Floats, poses: Floats) -> None:
    """Write stamps (n,), s, and planar poses (n, 3), m, m, rad, to the microsecond, micrometre and 1e-9 of quaternions."""
    half = 0.5 * poses[:, 2]
    # + 0.0 turns a negative zero into zero, so that equal poses look equal.
    columns = (stamps, poses[:, 0] + 0.0, poses[:, 1] + 0.0, np.sin(half) + 0.0, np.cos(half))
    rows = zip(*(c.tolist() for c in columns), strict=True)
    write_bytes(path, b"".join(map(b"%.6f %.6f %.6f 0 0 0 %.9f %.9f\n".__mod__, rows)))


def write_kitti(path: str | os.PathLike[str], poses: Floats) -> None:
    """Write planar poses (n, 3) as KITTI text: the upper three rows of the 4 x 4 pose matrix, row by row; no times."""
    rows = zip(poses[:, :2].tolist(), np.cos(poses[:, 2]).tolist(), np.sin(poses[:, 2]).tolist(), strict=True)
    text = "".join(f"{c:.9f} {-s + 0.0:.9f} 0 {x:.6f} {s:.9f} {c:.9f} 0 {y:.6f} 0 0 1 0\n" for (x, y), c, s in rows)
    write_bytes(path, text.encode())


def write_trajectory(path: str | os.PathLike[str], kind: str, stamps: Floats, poses: Floats) -> None:
    """Write stamps (n,) and poses (n, 3) as 'tum' or 'kitti'."""
    if kind == "tum":
        write_tum(path, stamps, poses)
    else:
        write_kitti(path, poses)


def read_tum(path: str | os.PathLike[str]) -> tuple[Floats, Floats]:
    """Read a TUM trajectory, plain or gzip; ``-`` = standard input; roll, pitch and height are dropped.

    Returns
    -------
    stamps : (n,) s, in the order of the file. poses : (n, 3) x, y and yaw; m, rad.
    """
    table = read_rows(path, "timestamp tx ty tz qx qy qz qw", "poses")
    qx, qy, qz, qw = table[:, 4:].T
    norm = qx * qx + qy * qy + qz * qz + qw * qw
    # Files without orientation write four zeros: heading 0.
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), norm - 2.0 * (qy * qy + qz * qz))
    return table[:, 0].copy(), np.stack([table[:, 1], table[:, 2], np.where(norm > 0, yaw, 0.0)], axis=1)


def read_rows(path: str | os.PathLike[str], columns: str, what: str) -> Floats:
    """Return the rows (n, 8), n >= 1, of a table of eight finite numbers a line; columns, what : of its rows, for messages."""
    parts, count = [], len(columns.split())
    with open_source(path) as source:
        for rows in filter(None, source.rows()):
            for number, words in rows:
                if len(words) != count:
                    raise FormatError(f"{len(words)} columns, expected {count}: {columns}", source.path, number)
            parts.append(number_table(rows, source.path))
        if not parts:
            raise FormatError(f"no {what} in it", source.path)
    return np.concatenate(parts)


def read_relations(path: str | os.PathLike[str]) -> tuple[Floats, Floats, Floats]:
    """Read relations between scans, as the SLAM benchmark of Kuemmerle et al. has them; height, roll and pitch are dropped.

    Returns
    -------
    stamp1, stamp2 : (r,) s. T_1_2 : (r, 3) pose of the second scan as seen from the first; m, m, rad.
    """
    table = read_rows(path, "stamp1 stamp2 x y z roll pitch yaw", "relations")
    return table[:, 0].copy(), table[:, 1].copy(), table[:, [2, 3, 7]].copy()
