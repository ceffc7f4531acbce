"""Work spread over processes, or done in this one: the results come in the order of the tasks either way.

The division into tasks does not depend on the number of workers; so neither does any result.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from typing import TypeVar

Task = TypeVar("Task")
Answer = TypeVar("Answer")


def in_order(work: Callable[[Task], Answer], tasks: Iterable[Task], executor: Executor | None = None) -> Iterator[Answer]:
    """Yield work(task) for every task.

    Parameters
    ----------
    work : a function of a module, so that it can be sent to another process.
    executor : any concurrent.futures executor; None = in this process, one task at a time.
    """
    yield from map(work, tasks) if executor is None else executor.map(work, list(tasks))
