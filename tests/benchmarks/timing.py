"""Timing that other load disturbs least, and what a figure is worth on a machine that is not free.

Figures are ratios of fastest rounds, taken in turn. On a free machine a goal is reached or missed. Where others take a
part of the cores a missed goal is skipped, with what was measured of them; where they leave no whole core a reached one
is skipped too, as that flatters: what takes longer is interrupted more, and more threads get a larger share.
"""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

TICKS_PER_SECOND = os.sysconf("SC_CLK_TCK")

FREE = 0.25
"""Cores that others may take on a free machine; half of it where all cores are timed."""

WHOLE_SECOND_CORE = 1.9
"""Least gain of the calibration loop from the second core; two threads of one physical core stay far below."""


def seconds(function: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def fastest(rounds: dict[str, Callable[[], object]], count: int) -> dict[str, float]:
    """Seconds of the fastest of `count` calls of each, called in turn so that other load hits all alike."""
    best = dict.fromkeys(rounds, np.inf)
    for _ in range(count):
        for name, function in rounds.items():
            best[name] = min(best[name], seconds(function))
    return best


REFERENCE_SECONDS = 0.026
"""Fastest `calibration` on the machine whose absolute figures are the goals."""


def calibration() -> object:
    """A fixed piece of work in NumPy and Python on one core."""
    values = np.random.default_rng(0).standard_normal(200_000)
    return np.sort(values)[0] + sum(k * k for k in range(300_000))


def slowness() -> float:
    """How many times slower this machine is than the one of the absolute goals; at least 1, so that none is eased on a
    fast machine."""
    return max(1.0, fastest({"work": calibration}, 15)["work"] / REFERENCE_SECONDS)


@dataclass(frozen=True)
class CoreTime:
    """Wall time, time in which cores were busy, and what of it this process and its ended children took, all in s."""

    wall: float
    busy: float
    own: float

    @classmethod
    def now(cls) -> "CoreTime":
        """The present reading."""
        used = os.times()
        return cls(time.perf_counter(), busy_seconds(Path("/proc/stat").read_text()), sum(used[:4]))

    def others_until(self, later: "CoreTime") -> float:
        """Cores that others kept busy between two readings, on average."""
        return max(0.0, (later.busy - self.busy) - (later.own - self.own)) / (later.wall - self.wall)


def busy_seconds(stat: str) -> float:
    """Time in which cores were not idle, from the text of /proc/stat; what a hypervisor stole counts as busy."""
    user, nice, system, _idle, _iowait, irq, softirq, steal = (int(word) for word in stat.split()[1:9])
    return (user + nice + system + irq + softirq + steal) / TICKS_PER_SECOND


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
        return f"others took {self.cores:.2f} of {os.cpu_count()} cores" if self.cores > limit else ""


def second_core_gain() -> float:
    """How much faster two threads of floating-point work are than one after the other: 2 on two whole, free cores."""

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


def judge(reached: bool, figure: str, load: OtherLoad, disturbed: str = "") -> None:
    """Pass or fail a goal, or skip it with the reason (see above); `disturbed` is one more not to judge a miss."""
    busy = load.more_than((os.cpu_count() or 1) - 0.9) if reached else disturbed or load.more_than(FREE)
    if busy:
        pytest.skip(f"{figure}: not judged on a busy machine, {busy}")
    if not reached:
        pytest.fail(figure)
