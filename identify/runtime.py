"""Cores of the machine, and a Ctrl-C that is neither lost nor leaves work half done."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess
from typing import ParamSpec, TypeVar, cast

from threadpoolctl import OpenBLASController, register, threadpool_limits


class _CasadiBlas(OpenBLASController):
    """BLAS that CasADi brings for IPOPT. Its name is one that threadpoolctl does not look for."""

    filename_prefixes = ("libcasadi-tp-openblas",)


register(_CasadiBlas)

P = ParamSpec("P")
R = TypeVar("R")
_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function so that every BLAS loaded by now uses one thread.

    A second thread slows the many small matrices of a search down: by a fifth on free cores, by
    half on busy ones. With one thread, rounding depends neither on the cores nor on the
    environment.
    """
    return cast(Callable[P, R], _one_thread(function))


def cores() -> int:
    """Return the number of cores that this process may use.

    Only Linux tells it. On other systems it is the number of cores of the machine.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


STOPPED = 130
"""Exit status of a command after Ctrl-C."""


class Noting:
    """Handler of Ctrl-C that raises KeyboardInterrupt and remembers that it came.

    It must remember, because an import may swallow the exception or turn it into another error. So
    may CasADi where it turns a matrix into an array.
    """

    def __init__(self) -> None:
        self.came = False

    def __call__(self, *_: object) -> None:
        """Handle the signal."""
        self.came = True
        raise KeyboardInterrupt


@contextmanager
def noted() -> Iterator[Noting]:
    """Note Ctrl-C while the block runs, for `raise_noted`.

    A block inside another uses the handler of the outer one, so both know of it.
    """
    old = signal.getsignal(signal.SIGINT)
    noting = old if isinstance(old, Noting) else Noting()
    if not _is_ours():
        yield noting
        return
    signal.signal(signal.SIGINT, noting)
    try:
        yield noting
    finally:
        signal.signal(signal.SIGINT, old)


def raise_noted() -> None:
    """Raise KeyboardInterrupt again if Ctrl-C came since the `noted` block began.

    Call it before long work begins.
    """
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Noting) and handler.came:
        raise KeyboardInterrupt


@contextmanager
def loading() -> Iterator[None]:
    """Raise KeyboardInterrupt at each import of the block once Ctrl-C came in a `noted` block.

    Libraries swallow the exception while they look for optional ones. All the others would then be
    loaded before the command ends, which takes a minute on a busy machine. Clean-up that imports
    does not belong in the block.
    """
    reminder = _Reminder()
    sys.meta_path.insert(0, reminder)
    try:
        yield
    finally:
        sys.meta_path.remove(reminder)


class _Reminder:
    """Finder of modules that finds none and reminds of Ctrl-C."""

    def find_spec(self, *_: object) -> None:
        raise_noted()


@contextmanager
def honoured() -> Iterator[None]:
    """Leave the block with KeyboardInterrupt after Ctrl-C, even if foreign code swallowed it.

    Foreign code may also have turned it into another error.
    """
    with noted() as noting:
        try:
            yield
        except Exception:
            if not noting.came:
                raise
        if noting.came:
            raise KeyboardInterrupt


@contextmanager
def held() -> Iterator[None]:
    """Delay Ctrl-C until the block has ended."""
    if not _is_ours():
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
        if came:  # the handler from before the block gets it now
            signal.raise_signal(signal.SIGINT)


@contextmanager
def deaf_offspring() -> Iterator[None]:
    """Hide Ctrl-C from the threads and processes that start in the block, and from their own.

    Ctrl-C is for the main process, which ends them. Windows has no such signal mask, and there the
    block changes nothing.
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
    """End this process when its parent is gone, even in the middle of work.

    Without this, a process of `multiprocessing` would wait or compute without end.
    """
    threading.Thread(target=_end_after, args=(parent_process(),), daemon=True).start()


def _end_after(parent: BaseProcess | None) -> None:
    if parent is not None:
        parent.join()
        os._exit(1)  # sys.exit would end this thread alone


def _is_ours() -> bool:
    """Tell whether Ctrl-C may be handled here.

    It may in the main thread, unless something has turned it off, as nohup does, and the shell of a
    script for a command in the background.
    """
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(signal.SIGINT) not in (signal.SIG_IGN, None)


def stoppable(command: Callable[P, None]) -> Callable[P, None]:
    """Decorate a command so that Ctrl-C ends it with one line and the exit status `STOPPED`.

    A command that reports Ctrl-C itself, by typer.Exit, is left alone.
    """

    import typer  # late: Ctrl-C while it is loaded is to be heard by `honoured`

    @wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        with noted() as interrupt:
            try:
                command(*arguments, **options)
            except typer.Exit:
                raise
            except (KeyboardInterrupt, Exception) as error:
                # An error after Ctrl-C is most likely what foreign code made of it.
                if isinstance(error, Exception) and not interrupt.came:
                    raise
                typer.echo(
                    "stopped: what is done is kept; the same command goes on from there", err=True
                )
                raise typer.Exit(STOPPED) from None

    return run
