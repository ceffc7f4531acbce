"""Arrays: names for their element types, checks of those from outside, tables joined, robust spreads, runs of flags."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from functools import cache
from typing import Any, ClassVar, Self, TypeVar, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError

_Joined = TypeVar("_Joined", bound="Table")
_Number = TypeVar("_Number", np.float64, np.intp, np.int64)

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
"""Numbers that index or count: as wide as addresses, because numpy takes no wider ones as indices on 32-bit machines."""
WIDE = np.int64
"""Element type of numbers that may exceed 32 bits, such as ids of files and row * columns + column; never an index."""
Wides = NDArray[np.int64]
Bools = NDArray[np.bool_]
Complexes = NDArray[np.complex128]

CHUNK = 1 << 14
"""Rows that are processed together, so that they stay in the processor's cache; bounds the memory, too."""
TINY = 1e-9
"""Length, m, time, s, or share below which a value is rounding error."""
MOST = 0.9
"""Share that is nearly all: of values, also as a quantile, of the points of a scan, of a direction that is measured."""
ENOUGH = 20
"""Number of values whose median, quantile or share is a figure, and that are neither alike nor odd by chance."""
BEYOND_NOISE = 5.0
"""Standard deviations that noise does not exceed."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation / median absolute deviation of normal errors: the inverse of their 0.75 quantile."""
OUTLIER = 3.0
"""Standard deviations beyond which an error is gross: of normal ones 0.3 %."""


class Table:
    """A dataclass of arrays, each with a row per entry; an empty one may stand for values that are not known."""

    __slots__ = ()

    SHARED: ClassVar[tuple[str, ...]] = ()
    """Names of the arrays that all entries share."""

    def columns(self) -> dict[str, Any]:
        """Return the arrays, and tables within it, with a row per entry by their names."""
        every = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        return {name: c for name, c in every.items() if isinstance(c, np.ndarray | Table) and name not in self.SHARED}

    def rows(self, which: slice | Ints | Bools) -> Self:
        """Return some of the entries; fields that are no columns are kept."""
        # Flags are searched once, and `take` needs half the time of an index for tables of two columns.
        numbers = np.flatnonzero(which) if isinstance(which, np.ndarray) and which.dtype == np.bool_ else which
        chosen: dict[str, Any] = {}
        for name, column in self.columns().items():
            if isinstance(column, Table):
                chosen[name] = column.rows(numbers)
            elif len(column):
                chosen[name] = column[numbers] if isinstance(numbers, slice) else column.take(numbers, axis=0)
        return replace(self, **chosen)  # type: ignore[type-var]


def renumbered(one: Ints, other: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the values of either of two arrays (e,), (e,), ascending, and the positions among them of the values of both."""
    used, number = np.unique(np.concatenate([one, other]), return_inverse=True)
    where = number.reshape(-1).astype(np.intp)
    return used, where[: len(one)], where[len(one) :]


def chunks(rows: int, size: int = CHUNK) -> Iterator[slice]:
    """Yield some rows at a time."""
    for first in range(0, rows, size):
        yield slice(first, min(first + size, rows))


def evenly(count: int, most: int) -> Ints:
    """Return at most so many of count indices, evenly spread, first and last among them."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)


def numbered(counts: Ints) -> tuple[Ints, Ints]:
    """Return, of so many entries (n,) of each group one after another, the group of each and its number within the group."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - (np.cumsum(counts) - counts)[group]


def run_starts(*columns: NDArray[Any]) -> Ints:
    """Return the first row (r,) of each run of rows in which no column (n,) changes."""
    fresh = np.ones(len(columns[0]), dtype=bool)
    fresh[1:] = np.logical_or.reduce([column[1:] != column[:-1] for column in columns])
    return np.flatnonzero(fresh)


def stable_order(keys: Wides) -> Ints:
    """Return the stable order (n,) of keys (n,), 0 or more: key and place as one number sort in a fifth of the time."""
    bits = len(keys).bit_length()
    if int(keys.max(initial=0)).bit_length() + bits >= np.iinfo(WIDE).bits:
        return np.argsort(keys, kind="stable")
    return (np.sort((keys << bits) | np.arange(len(keys))) & ((1 << bits) - 1)).astype(np.intp, copy=False)


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
    """Return tables of one kind as one: the rows of each part after those of the one before; the first one's other fields."""
    if len(parts) == 1:
        return parts[0]
    each = [part.columns() for part in parts]
    columns = {name: [part[name] for part in each] for name in each[0]}
    whole = {n: concatenated(c) if isinstance(c[0], Table) else np.concatenate(c) for n, c in columns.items()}
    return replace(parts[0], **whole)  # type: ignore[type-var]


def connected(one: Ints, other: Ints, many: int) -> Ints:
    """Return the number (n,) of the part to which each of many nodes belongs, by ties (e,), (e,)."""
    from scipy import sparse  # a sixth of a second, which readers of files do without
    from scipy.sparse.csgraph import connected_components

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


def best_run(gain: Floats) -> tuple[int, int]:
    """Return begin and end of the run of greatest sum (Kadane)."""
    sums = np.append(0.0, np.cumsum(gain))
    end = int(np.argmax(sums - np.minimum.accumulate(sums)))
    return int(np.argmin(sums[: end + 1])), end


def spread(errors: Floats) -> float:
    """Return the robust standard deviation of errors (m,) about zero, by their median size; half may be outliers."""
    return MAD_TO_SIGMA * float(np.median(np.abs(errors)))


def spread_about_median(values: Floats) -> float:
    """Return the robust standard deviation of values (m,) about their median."""
    return spread(values - np.median(values))


def bends(values: Floats) -> Floats:
    """Return the second differences (m - 2,) of a series (m,), m > 1, scaled: those of white noise have its standard deviation.

    With half of the neighbours taken off, they have 3/2 of its variance.
    """
    return np.asarray((values[1:-1] - 0.5 * (values[:-2] + values[2:])) / np.sqrt(1.5))


def white_noise(values: Floats) -> float:
    """Return the robust standard deviation of the noise of a smooth series (m,), m > 2, by its second differences."""
    return spread(bends(values))


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


Shape = tuple[int | str, ...]
"""Lengths of an array; a name stands for a length that is the same wherever the name stands."""

_WANTED = {np.floating: "numbers", np.integer: "whole numbers", np.bool_: "True or False"}
_TAKEN = {np.floating: "fiu", np.integer: "iu", np.bool_: "b"}
"""Kinds of numpy types that are taken for each."""


def as_array(values: ArrayLike, name: str, kind: Any = np.float64) -> NDArray[Any]:
    """Return an array, a list or a tuple as an array of a kind; whole numbers are taken for numbers.

    Parameters
    ----------
    name : of the argument, for the message. kind : numpy type; an array of integers keeps its own width where that is less,
    because numpy takes no indices wider than addresses.

    Raises
    ------
    DataError : it holds something else, or rows of different lengths.
    """
    family = next(f for f in _WANTED if issubclass(kind, f))
    try:
        array = np.asarray(values)
    except (ValueError, TypeError) as error:
        raise DataError(f"{name} is no array: {error}") from None
    if array.size and array.dtype.kind not in _TAKEN[family]:
        example = repr(array.flat[0])[:40]
        raise DataError(f"{name} must hold {_WANTED[family]}, not {array.dtype.name} such as {example}")
    if family is not np.integer or array.dtype.kind not in "iu":
        return array.astype(kind, copy=False)
    if array.dtype.itemsize <= np.dtype(kind).itemsize:
        return array
    narrow = array.astype(kind)
    if (narrow != array).any():
        raise DataError(f"{name} holds {array[narrow != array].flat[0]}, which does not fit into {np.dtype(kind).name}")
    return narrow


def require_shape(array: NDArray[Any], name: str, shape: Shape, known: dict[str, tuple[int, str]] | None = None) -> None:
    """Raise DataError where an array has another shape.

    Parameters
    ----------
    known : length behind each name so far, and the array that has it; new ones are added.
    """
    known = {} if known is None else known
    fits = array.ndim == len(shape)
    for wanted, length in zip(shape, array.shape, strict=False):
        if fits and isinstance(wanted, str):
            wanted = known.setdefault(wanted, (length, name))[0]
        fits = fits and wanted == length
    if not fits:
        lengths = ", ".join(f"{n} = {known[n][0]} as of {known[n][1]}" for n in shape if isinstance(n, str) and n in known)
        wanted = "(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")"
        raise DataError(f"{name} has shape {array.shape}, expected {wanted}{' with ' if lengths else ''}{lengths}")


def require_finite(array: NDArray[Any], name: str, most: float = np.inf) -> None:
    """Raise DataError where a row of an array is not finite, or has a number beyond the largest."""
    axes = tuple(range(1, array.ndim))
    bad = np.flatnonzero(~np.isfinite(array).all(axis=axes))
    if len(bad):
        raise DataError(f"{name}[{bad[0]}] is not finite ({len(bad)} such rows)")
    far = np.flatnonzero((np.abs(array) > most).any(axis=axes))
    if len(far):
        raise DataError(f"{name}[{far[0]}] is beyond {most:g} ({len(far)} such rows); are the units right?")


def require_index(index: NDArray[Any], name: str, count: int, of: str, least: int = 0) -> None:
    """Raise DataError where an array of indices holds one below the least or not below the count.

    Parameters
    ----------
    of : what they count. least : -1 where that stands for none.
    """
    if index.size and not least <= int(index.min()) <= int(index.max()) < count:
        wrong = int(index.min()) if int(index.min()) < least else int(index.max())
        row = int(np.argwhere(index == wrong)[0, 0])
        span = f"{least} to {count - 1}" if count else "there are none"
        raise DataError(f"{name}[{row}] = {wrong} is no index of {count} {of} ({span})")


def require_type(value: Any, name: str, kind: type, what: str = "") -> None:
    """Raise DataError where an argument is of another type; what: the type in words, where its own name is none."""
    if not isinstance(value, kind):
        wanted = what or kind.__name__
        raise DataError(f"{name} must be {'an' if wanted[0] in 'AEIO' else 'a'} {wanted}, not {_described(value)}")


def _described(value: Any) -> str:
    name = type(value).__name__
    return f"{name} {value!r:.40}" if isinstance(value, (str, int, float)) else name


def settle(table: Any, name: str, shapes: Mapping[str, Shape]) -> None:
    """Make the fields of a frozen dataclass arrays of the kinds that their annotations state, and require their shapes.

    A field may be None where its annotation allows that, and empty where it has a default that is.

    Parameters
    ----------
    name : before the fields' names in messages. shapes : of fields by name.

    Raises
    ------
    DataError : a field has another shape or holds something else.
    """
    known: dict[str, tuple[int, str]] = {}
    kinds = array_fields(type(table))
    for field, shape in shapes.items():
        kind, optional, may_be_empty = kinds[field]
        value = getattr(table, field)
        if value is None and optional:
            continue
        array = as_array(value, f"{name}.{field}", kind)
        if not array.size and array.ndim == 1 and len(shape) > 1 and isinstance(shape[0], str):
            array = array.reshape(0, *(n if isinstance(n, int) else 0 for n in shape[1:]))
        if array is not value:
            object.__setattr__(table, field, array)
        if array.size or not may_be_empty:
            require_shape(array, f"{name}.{field}", shape, known)


def _array_fields(cls: type) -> dict[str, tuple[Any, bool, bool]]:
    """Return of each field of a dataclass that is an array its numpy type, whether it may be None and may be left empty."""
    found = {}
    for f in fields(cls):
        hints: Sequence[Any] = (f.type, *get_args(f.type))
        kind = next((get_args(get_args(h)[1])[0] for h in hints if get_origin(h) is np.ndarray), None)
        if kind is not None:
            found[f.name] = kind, type(None) in get_args(f.type), f.default_factory is not MISSING
    return found


array_fields: Callable[[type], dict[str, tuple[Any, bool, bool]]] = cache(_array_fields)
"""The same, found once for each class."""
