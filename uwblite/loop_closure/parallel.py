"""Pairs of sub-maps in batches, spread over processes or done in this one: the results come in the order of the tasks.

The division into batches does not depend on the number of workers; so neither does any result.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from typing import TypeVar

from ..arrays import Ints, chunks, renumbered

Task = TypeVar("Task")
Answer = TypeVar("Answer")

_AT_ONCE = 32
"""Pairs of a batch."""


def batches(target: Ints, source: Ints) -> Iterator[tuple[slice, Ints, Ints, Ints]]:
    """Yield the rows of some pairs at a time, the sub-maps of these, and their numbers among them of targets and sources."""
    for rows in chunks(len(target), _AT_ONCE):
        yield rows, *renumbered(target[rows], source[rows])


def in_order(work: Callable[[Task], Answer], tasks: Iterable[Task], executor: Executor | None = None) -> Iterator[Answer]:
    """Yield work(task) for every task; work is a function of a module, so that it can be sent to another process."""
    yield from map(work, tasks) if executor is None else executor.map(work, list(tasks))
