"""The machine under a run: its cores, and Ctrl-C, which neither is lost nor leaves anything half
done.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from multiprocessing import parent_process
from multiprocessing.process import BaseProcess
from typing import ParamSpec, TypeVar, cast

import typer
from threadpoolctl import OpenBLASController, register, threadpool_limits


class _CasadiBlas(OpenBLASController):
    """The BLAS that CasADi brings for IPOPT, under a name that threadpoolctl does not look for."""

    filename_prefixes = ("libcasadi-tp-openblas",)


register(_CasadiBlas)

P = ParamSpec("P")
R = TypeVar("R")
_one_thread = threadpool_limits.wrap(limits=1, user_api="blas")


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: every BLAS that is loaded by now uses one thread.

    The many small matrices of a search lose by a second one (a fifth of the time on free cores,
    half on busy ones), and with one the rounding does not depend on the machine's cores or on its
    environment.
    """
    return cast(Callable[P, R], _one_thread(function))


def cores() -> int:
    """Cores that this process may use; where only Linux can say so, all of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


STOPPED = 130
"""Exit status of a command after Ctrl-C."""


class Noting:
    """A handler of Ctrl-C that raises KeyboardInterrupt, and keeps in mind that it came: an import
    may swallow the exception, or make another error of it, and so may CasADi where it turns a
    matrix into an array."""

    def __init__(self) -> None:
        self.came = False

    def __call__(self, *_: object) -> None:
        """Handle the signal."""
        self.came = True
        raise KeyboardInterrupt


@contextmanager
def noted() -> Iterator[Noting]:
    """Ctrl-C is noted in the block, for `raise_noted`; in a block inside another, for both."""
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
    """Raise KeyboardInterrupt once more if there was one since `noted`; call it before long work
    begins.
    """
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Noting) and handler.came:
        raise KeyboardInterrupt


@contextmanager
def honoured() -> Iterator[None]:
    """Ctrl-C leaves the block as KeyboardInterrupt, also where foreign code swallowed it or made
    another error.
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
    """Ctrl-C waits until the block has ended."""
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
        if came:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def deaf_offspring() -> Iterator[None]:
    """Threads and processes that are started in the block, and those that they start, never hear
    Ctrl-C: it is for the main process, which ends them. Windows knows no such mask."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """Have this process end when the one that started it is gone, also in the middle of work.

    A process of `multiprocessing` would otherwise wait for work, or do it, without end.
    """
    threading.Thread(target=_end_after, args=(parent_process(),), daemon=True).start()


def _end_after(parent: BaseProcess | None) -> None:
    if parent is not None:
        parent.join()
        os._exit(1)


def _is_ours() -> bool:
    """Whether Ctrl-C may be handled here: in the main thread, and where nobody, such as nohup, has
    turned it off.
    """
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(signal.SIGINT) not in (signal.SIG_IGN, None)


def stoppable(command: Callable[P, None]) -> Callable[P, None]:
    """The command, which says in one line that Ctrl-C stopped it where it does not say so
    itself."""

    @wraps(command)
    def run(*arguments: P.args, **options: P.kwargs) -> None:
        with noted() as interrupt:
            try:
                command(*arguments, **options)
            except typer.Exit:
                raise
            except (KeyboardInterrupt, Exception) as error:
                if isinstance(error, Exception) and not interrupt.came:
                    raise
                typer.echo(
                    "stopped: what is done is kept; the same command goes on from there", err=True
                )
                raise typer.Exit(STOPPED) from None

    return run
