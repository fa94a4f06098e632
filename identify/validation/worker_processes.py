"""Distribution of work to processes of this machine that end with their parent process."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, resource_tracker
from typing import Any, TypeVar

from identify.runtime import delay_interrupts, end_with_parent, shield_children

R = TypeVar("R")


@contextmanager
def mapped(
    count: int | None,
    function: Callable[..., R],
    *tasks: Iterable[Any],
    start: Callable[[], object] | None = None,
) -> Iterator[Iterator[R]]:
    """Yield the results of a function for each task, in their order, computed in new processes.

    Ctrl-C is blocked in the processes. They end at once when an exception such as Ctrl-C leaves the
    block, or when this process has ended.

    Parameters
    ----------
    count : int, optional
        Number of processes. None means one process per core.
    function : callable
        Function that is called with one item of each of the `tasks`.
    *tasks : iterables
        Items for each argument of the function.
    start : callable, optional
        Function that each process calls first.
    """
    resource_tracker.ensure_running()  # a later start would unblock Ctrl-C
    others = set(active_children())
    with ProcessPoolExecutor(count, get_context("spawn"), _begin, (start,)) as pool:
        try:
            with shield_children():  # the pool starts its processes when it gets the tasks
                found = pool.map(function, *tasks)
            yield found
        except BaseException:
            with delay_interrupts():
                for process in set(active_children()) - others:
                    process.kill()
            raise


def _begin(start: Callable[[], object] | None) -> None:
    end_with_parent()
    if start is not None:
        start()
