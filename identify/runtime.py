"""Cores, threads and processes of this machine, and reliable handling of Ctrl-C."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import wraps
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from typing import Any, ParamSpec, TypeVar, cast

from threadpoolctl import OpenBLASController, register, threadpool_limits


class _CasadiBlas(OpenBLASController):
    """BLAS library that CasADi ships for IPOPT. threadpoolctl does not know its file name."""

    filename_prefixes = ("libcasadi-tp-openblas",)


register(_CasadiBlas)

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")
_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")


def in_threads(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
    """Yield what a function returns for each item, computed in `threads()` threads.

    The results come in the order of the items. Threads are enough for runs of the compiled loop,
    which does not hold Python's global lock. The function must not call CasADi, which is not safe
    in threads.
    """
    if threads() == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads()) as pool:
        yield from pool.map(function, items)


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function so that every loaded BLAS library uses one thread.

    A second thread makes the many small matrix products of a search slower, by a fifth on idle
    cores and by half on busy cores. With one thread, rounding does not depend on the number of
    cores or on the environment.
    """
    return cast(Callable[P, R], _one_thread(function))


def cores() -> int:
    """Return the number of cores that this process is allowed to use.

    On systems that do not report this, all cores of the machine are counted.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Return the number of threads for computations: one per core, or OMP_NUM_THREADS if fewer.

    Studies set this variable for their processes, of which there are as many as cores.
    """
    most = os.environ.get("OMP_NUM_THREADS", "")
    return min(max(int(most), 1), cores()) if most.isdecimal() else cores()


STOPPED = 130  # exit status of a command after Ctrl-C


class InterruptHandler:
    """Handler of Ctrl-C that raises KeyboardInterrupt and records that Ctrl-C came.

    The record is needed because an import, or CasADi during the conversion of a matrix to an array,
    can swallow the exception or turn it into another error.
    """

    def __init__(self) -> None:
        self.came = False

    def __call__(self, *_: object) -> None:
        """Handle the signal."""
        self.came = True
        raise KeyboardInterrupt


@contextmanager
def record_interrupts() -> Iterator[InterruptHandler]:
    """Record Ctrl-C while the block runs, for `raise_interrupt`.

    A nested block uses the handler of the outer block, so Ctrl-C is recorded in both. In a thread
    that cannot handle Ctrl-C, nothing is recorded.
    """
    old = signal.getsignal(signal.SIGINT)
    handler = old if isinstance(old, InterruptHandler) else InterruptHandler()
    if not _can_handle_interrupts():
        yield handler
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield handler
    finally:
        signal.signal(signal.SIGINT, old)


def raise_interrupt() -> None:
    """Raise KeyboardInterrupt again if Ctrl-C came since the `record_interrupts` block began."""
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, InterruptHandler) and handler.came:
        raise KeyboardInterrupt


@contextmanager
def interruptible_imports() -> Iterator[None]:
    """Raise KeyboardInterrupt at each import in the block after `record_interrupts` saw Ctrl-C.

    Libraries that look for optional libraries can swallow the first exception. All further
    libraries would then be loaded before the command ends, which takes a minute on a busy machine.
    Clean-up code with imports does not belong in the block.
    """
    finder = _InterruptingFinder()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)


class _InterruptingFinder:
    """Module finder that finds no modules, and raises KeyboardInterrupt after Ctrl-C."""

    def find_spec(self, *_: object) -> None:
        raise_interrupt()


@contextmanager
def interruptible() -> Iterator[None]:
    """Leave the block with KeyboardInterrupt after Ctrl-C.

    This holds even if a library has swallowed the exception or turned it into another error.
    """
    with record_interrupts() as handler:
        try:
            yield
        except Exception:
            if not handler.came:
                raise
        if handler.came:
            raise KeyboardInterrupt


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Delay Ctrl-C until the block has ended."""
    if not _can_handle_interrupts():
        yield
        return
    came = False

    def wait(*_: object) -> None:
        nonlocal came
        came = True

    old = signal.signal(signal.SIGINT, wait)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, old)
        if came:  # the handler from before the block gets the signal now
            signal.raise_signal(signal.SIGINT)


@contextmanager
def shield_children() -> Iterator[None]:
    """Block Ctrl-C in the threads and processes that start in the block, and in their children.

    Only the main process handles Ctrl-C, and ends the others. On Windows, which has no such signal
    mask, this has no effect.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """End this process when its parent has ended, even in the middle of work.

    Without this, a process of `multiprocessing` would wait or compute forever.
    """
    threading.Thread(target=_end_after, args=(parent_process(),), daemon=True).start()


def _end_after(parent: BaseProcess | None) -> None:
    if parent is not None:
        parent.join()
        os._exit(1)  # sys.exit would end only this thread


@contextmanager
def mapped(
    count: int | None,
    function: Callable[..., R],
    *tasks: Iterable[Any],
    start: Callable[[], object] | None = None,
) -> Iterator[Iterator[R]]:
    """Yield an iterator over the results of a function for each task, computed in new processes.

    The results come in the order of the tasks. Ctrl-C is blocked in the processes. They end at once
    when an exception such as KeyboardInterrupt leaves the block, or when this process has ended.

    count     Number of processes. None means one process per core.
    function  Function that is called with one item of each of the `tasks`.
    *tasks    Items for each argument of the function.
    start     Function that each process calls first.
    """
    resource_tracker.ensure_running()  # a later start would unblock Ctrl-C
    others = set(active_children())
    with ProcessPoolExecutor(count, get_context("spawn"), _begin, (start,)) as pool:
        try:
            with shield_children():  # the pool starts its processes when it gets the tasks
                outputs = pool.map(function, *tasks)
            yield outputs
        except BaseException:
            with delay_interrupts():
                for process in set(active_children()) - others:
                    process.kill()
            raise


def _begin(start: Callable[[], object] | None) -> None:
    end_with_parent()
    if start is not None:
        start()


def _can_handle_interrupts() -> bool:
    """Return whether this thread can handle Ctrl-C, which only the main thread can.

    nohup, or the shell for a background command of a script, turns the signal off.
    """
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(signal.SIGINT) not in (signal.SIG_IGN, None)


def stoppable(command: Callable[P, None]) -> Callable[P, None]:
    """Decorate a command so that Ctrl-C ends it with one line and the exit status `STOPPED`.

    A command that reports Ctrl-C itself, by typer.Exit, is not changed.
    """

    import typer  # late, so that Ctrl-C during this import is handled by `interruptible`

    @wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        with record_interrupts() as interrupt:
            try:
                command(*arguments, **options)
            except typer.Exit:
                raise
            except (KeyboardInterrupt, Exception) as error:
                # An error after Ctrl-C is most likely KeyboardInterrupt, converted by a library.
                if isinstance(error, Exception) and not interrupt.came:
                    raise
                typer.echo(
                    "stopped: finished work is stored; the same command continues from there",
                    err=True,
                )
                raise typer.Exit(STOPPED) from None

    return run
