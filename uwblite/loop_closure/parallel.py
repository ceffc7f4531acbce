"""Work spread over processes, or over nothing: the answers come in the order of the tasks either way.

Tasks are cut so that they do not depend on how many workers there are; so neither does any result.
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
    executor : any concurrent.futures executor; None = here and now, a task at a time.
    """
    yield from map(work, tasks) if executor is None else executor.map(work, list(tasks))
