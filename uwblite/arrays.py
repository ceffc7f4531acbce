"""Names for arrays of one element type (shapes stand where an array is used), tables joined, robust spreads, runs of flags."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

_Joined = TypeVar("_Joined")
_Number = TypeVar("_Number", np.float64, np.intp, np.int64)

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
"""Numbers that index or count: as wide as addresses, because numpy takes no wider ones as indices on 32-bit machines."""
WIDE = np.int64
"""Element type of numbers that may exceed 32 bits, such as ids of files and row * columns + column; never an index."""
Wides = NDArray[np.int64]
Bools = NDArray[np.bool_]

MAD_TO_SIGMA = 1.4826
"""Standard deviation / median absolute deviation of normal errors: the inverse of their 0.75 quantile."""
MEDIAN_TO_MEAN = 1.2533
"""Standard deviation of a median of normal values / that of their mean: sqrt(pi / 2)."""


class Table:
    """A dataclass of arrays, each with a row per entry."""

    __slots__ = ()

    def rows(self, which: slice | Ints | Bools) -> Self:
        """Return some of the entries, of tables within it, too; fields that are neither are kept."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        tables = {name: column.rows(which) for name, column in columns.items() if isinstance(column, Table)}
        arrays = {name: column for name, column in columns.items() if isinstance(column, np.ndarray)}
        if isinstance(which, slice):
            return replace(self, **tables, **{name: column[which] for name, column in arrays.items()})  # type: ignore[type-var]
        # Flags are searched once, and `take` needs half the time of an index for tables of two columns.
        numbers = np.flatnonzero(which) if which.dtype == np.bool_ else which
        return replace(self, **tables, **{name: column.take(numbers, axis=0) for name, column in arrays.items()})  # type: ignore[type-var]


def renumbered(one: Ints, other: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the values of either of two arrays (e,), (e,), ascending, and the positions among them of the values of both."""
    used, number = np.unique(np.concatenate([one, other]), return_inverse=True)
    where = number.reshape(-1).astype(np.intp)
    return used, where[: len(one)], where[len(one) :]


def unique_rows(rows: NDArray[_Number]) -> tuple[NDArray[_Number], Ints]:
    """Return the different rows (u, k) of a table (n, k), ascending, and which of them each row is (n,).

    The same as numpy.unique with axis=0, which sorts rows as wholes and takes ten times as long.
    """
    order = np.lexsort(rows.T[::-1])
    ascending = rows[order]
    fresh = np.ones(len(rows), dtype=bool)
    fresh[1:] = np.any(ascending[1:] != ascending[:-1], axis=1)
    number = np.empty(len(rows), dtype=np.intp)
    number[order] = np.cumsum(fresh) - 1
    return ascending[fresh], number


def concatenated(parts: Sequence[_Joined]) -> _Joined:
    """Return dataclasses of arrays, all of one kind, as one: the rows of each part after those of the one before.

    A field may be such a dataclass itself.
    """
    columns = {f.name: [getattr(part, f.name) for part in parts] for f in fields(parts[0])}  # type: ignore[arg-type]
    whole = {n: np.concatenate(c) if isinstance(c[0], np.ndarray) else concatenated(c) for n, c in columns.items()}
    return replace(parts[0], **whole)  # type: ignore[type-var]


def connected(one: Ints, other: Ints, many: int) -> Ints:
    """Return the number (n,) of the part to which each of many nodes belongs, by ties (e,), (e,)."""
    ties = sparse.coo_matrix((np.ones(len(one), dtype=np.int8), (one, other)), shape=(many, many))
    return np.asarray(connected_components(ties, directed=False)[1], dtype=np.intp)


def dots(one: NDArray[np.floating], other: NDArray[np.floating]) -> Floats:
    """Return the products (n,) of vectors (n, 2), row by row: summed along rows of two it takes several times as long."""
    return np.asarray(one[:, 0] * other[:, 0] + one[:, 1] * other[:, 1])


def rms_length(vectors: Floats) -> float:
    """Return the root mean square length of vectors (n, d)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def runs_of(flags: Bools) -> list[tuple[int, int]]:
    """Return first and one past the last of each run of set flags (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.intp)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def spread(errors: Floats) -> float:
    """Return the robust standard deviation of errors (m,) about zero, by their median size; half may be outliers."""
    return MAD_TO_SIGMA * float(np.median(np.abs(errors)))


def spread_about_median(values: Floats) -> float:
    """Return the robust standard deviation of values (m,) about their median."""
    return spread(values - np.median(values))


def sigma_of_median(values: Floats) -> float:
    """Return the standard deviation of the median of values (m,)."""
    return MEDIAN_TO_MEAN * spread_about_median(values) / float(np.sqrt(len(values)))


def white_noise(values: Floats) -> float:
    """Return the robust standard deviation of the noise of a smooth series (m,), m > 2, by its second differences.

    With half of the neighbours taken off, those of white noise have 3/2 of its variance.
    """
    return spread(values[1:-1] - 0.5 * (values[:-2] + values[2:])) / float(np.sqrt(1.5))


def row_medians(values: Floats) -> Floats:
    """Return the median (n,) of each row of values (n, m), m >= 1, none of them nan.

    The same bits as numpy.median's, which partitions rows at both middles and takes several times as long for short ones.
    """
    middle = values.shape[1] // 2
    parted = np.partition(values, middle, axis=1)
    upper = parted[:, middle]
    lower = upper if values.shape[1] % 2 else parted[:, :middle].max(axis=1)
    return np.asarray(0.5 * (lower + upper))


def weighted_median(values: Floats, weights: Floats) -> float:
    """Return the value up to which half of the weight lies, of values and weights (m,), m >= 1."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
