"""Timing that other load disturbs least, and what a figure is worth on a machine that is not free.

Goals are ratios of fastest rounds in one run, taken in turn; times alone are recorded and never
judged. On a free machine a goal is reached or missed. Where others take a part of the cores a
missed goal is skipped, with what was measured of them; where they leave no whole core a reached one
is skipped too, as that flatters: what takes longer is interrupted more, and more threads get a
larger share.
"""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import psutil
import pytest

FREE = 0.25  # cores that others may take on a free machine; half of it where all cores are timed
# Least gain of a loop from the second core; two threads of one physical core stay far below.
WHOLE_SECOND_CORE = 1.9


def seconds(function: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def fastest(rounds: dict[str, Callable[[], object]], count: int) -> dict[str, float]:
    """Seconds of the fastest of `count` calls of each, called in turn so that other load hits all
    alike.
    """
    best = dict.fromkeys(rounds, np.inf)
    for _ in range(count):
        for name, function in rounds.items():
            best[name] = min(best[name], seconds(function))
    return best


def plain_work() -> object:
    """A fixed piece of work in NumPy and Python on one core, by which others can be measured."""
    values = np.random.default_rng(0).standard_normal(200_000)
    return np.sort(values)[0] + sum(k * k for k in range(300_000))


@dataclass(frozen=True)
class CoreTime:
    """Wall time, time in which cores were busy, and what of it this process and its children took,
    all in s.
    """

    wall: float
    busy: float
    own: float

    @classmethod
    def now(cls) -> "CoreTime":
        """The present reading; what a hypervisor stole counts as busy, of the children also those
        that live on.
        """
        cores, here = psutil.cpu_times(), psutil.Process()
        own = sum(here.cpu_times()[:4]) + sum(
            sum(child.cpu_times()[:2]) for child in here.children(recursive=True)
        )
        busy = cores.user + cores.nice + cores.system + cores.irq + cores.softirq + cores.steal
        return cls(time.perf_counter(), busy, own)

    def others_until(self, later: "CoreTime") -> float:
        """Cores that others kept busy between two readings, on average."""
        return max(0.0, (later.busy - self.busy) - (later.own - self.own)) / (
            later.wall - self.wall
        )


class OtherLoad:
    """Watches while its block runs how many cores others take, on average."""

    cores = 0.0

    def __enter__(self) -> "OtherLoad":
        self._start = CoreTime.now()
        return self

    def __exit__(self, *_: object) -> None:
        self.cores = self._start.others_until(CoreTime.now())

    def more_than(self, limit: float) -> str:
        """In words that others took more cores than a limit; empty where they did not."""
        return (
            f"others took {self.cores:.2f} of {os.cpu_count()} cores" if self.cores > limit else ""
        )


def second_core_gain() -> float:
    """How much faster two threads of floating-point work are than one after the other: 2 on two
    whole, free cores.
    """

    def work() -> None:
        numbers, out = np.linspace(0, 1, 20_000), np.empty(20_000)
        for _ in range(1000):
            np.exp(numbers, out=out)

    def both() -> None:
        threads = [threading.Thread(target=work) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    best = fastest({"one": work, "two": both}, 5)
    return 2 * best["one"] / best["two"]


def resident_bytes() -> int:
    """Memory in use now; the peak of the process would hide growth below what earlier tests
    took."""
    return psutil.Process().memory_info().rss


def judge(reached: bool, figure: str, load: OtherLoad, disturbed: str = "") -> None:
    """Pass or fail a goal, or skip it with the reason (see above); `disturbed` is one more not to
    judge a miss.
    """
    busy = (
        load.more_than((os.cpu_count() or 1) - 0.9)
        if reached
        else disturbed or load.more_than(FREE)
    )
    if busy:
        pytest.skip(f"{figure}: not judged on a busy machine, {busy}")
    if not reached:
        pytest.fail(figure)
