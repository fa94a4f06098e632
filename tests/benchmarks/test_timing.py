"""A goal is judged by what was measured of the machine, not by chance."""

import os
import subprocess
import sys
import time

import pytest

from tests.benchmarks.timing import (
    FREE,
    TICKS_PER_SECOND,
    CoreTime,
    OtherLoad,
    busy_seconds,
    fastest,
    judge,
    second_core_gain,
)


def test_fastest_takes_turns_and_keeps_the_best_round():
    called, naps = [], iter([0.02, 0.0, 0.02])
    best = fastest({"a": lambda: (called.append("a"), time.sleep(next(naps))), "b": lambda: called.append("b")}, 3)
    assert called == ["a", "b"] * 3
    assert best["a"] < 0.01


def test_busy_time_is_all_but_idle_and_waiting():
    stat = "cpu  100 20 30 99999 88888 4 5 6 0 0\ncpu0 1 2 3 4 5 6 7 8 0 0\n"
    assert busy_seconds(stat) == 165 / TICKS_PER_SECOND


@pytest.mark.parametrize(("busy", "own", "others"), [(3.0, 3.0, 0.0), (5.0, 3.0, 0.5), (2.9, 3.0, 0.0)])
def test_load_of_others_leaves_the_own_out(busy, own, others):
    assert CoreTime(10.0, 100.0, 50.0).others_until(CoreTime(14.0, 100.0 + busy, 50.0 + own)) == others


def test_another_process_is_seen_and_named_as_the_reason():
    with OtherLoad() as load:
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        time.sleep(1.0)
    busy.kill()
    busy.wait()
    assert load.cores > FREE
    assert load.more_than(FREE) == f"others took {load.cores:.2f} of {os.cpu_count()} cores"
    assert load.more_than(load.cores) == ""


def test_second_core_gains_nothing_where_there_is_one():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert second_core_gain() < 1.3
    finally:
        os.sched_setaffinity(0, allowed)


def load_of(cores):
    load = OtherLoad()
    load.cores = cores
    return load


@pytest.fixture
def two_cores(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)


def test_free_machine_passes_a_goal_reached_and_fails_a_goal_missed(two_cores):
    judge(True, "ratio 9, goal 8", load_of(0.1))
    with pytest.raises(pytest.fail.Exception, match="ratio 7, goal 8"):
        judge(False, "ratio 7, goal 8", load_of(0.1))


def test_goal_missed_beside_others_is_skipped_with_what_was_measured(two_cores):
    with pytest.raises(pytest.skip.Exception, match=r"ratio 7: not judged .*, others took 0\.50 of 2 cores"):
        judge(False, "ratio 7", load_of(0.5))
    with pytest.raises(pytest.skip.Exception, match=r"gain 1\.5: not judged .*, the second core is half a core"):
        judge(False, "gain 1.5", load_of(0.0), "the second core is half a core")


def test_goal_reached_counts_as_long_as_others_leave_a_core(two_cores):
    judge(True, "ratio 9", load_of(1.0))
    judge(True, "gain 1.9", load_of(0.0), "the second core is half a core")
    with pytest.raises(pytest.skip.Exception, match=r"ratio 9: not judged .*, others took 1\.40 of 2 cores"):
        judge(True, "ratio 9", load_of(1.4))
