"""Arrays that enter from outside: which shape and kind each must have, and what is said where one has not."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from functools import cache
from typing import Any, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import DataError

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
        raise DataError(f"{name} must be a {what or kind.__name__}, not {_described(value)}")


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
