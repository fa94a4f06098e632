"""A goal is judged by what was measured of the machine."""

import os
import subprocess
import sys
import time

import pytest

from tests.benchmarks.timing import FREE, CoreTime, OtherLoad, fastest, judge, second_core_gain


def test_fastest_takes_turns_and_keeps_the_best_round():
    called, naps = [], iter([0.1, 0.0, 0.1])
    best = fastest(
        {
            "a": lambda: (called.append("a"), time.sleep(next(naps))),
            "b": lambda: called.append("b"),
        },
        3,
    )
    assert called == ["a", "b"] * 3
    assert best["a"] < 0.1


@pytest.mark.parametrize(
    ("busy", "own", "others"), [(3.0, 3.0, 0.0), (5.0, 3.0, 0.5), (2.9, 3.0, 0.0)]
)
def test_load_of_others_leaves_the_own_out(busy, own, others):
    assert (
        CoreTime(10.0, 100.0, 50.0).others_until(CoreTime(14.0, 100.0 + busy, 50.0 + own)) == others
    )


@pytest.mark.thorough
def test_a_child_is_the_own_load_and_a_stranger_is_seen_and_named():
    command = [sys.executable, "-c", "while True: pass"]
    with OtherLoad() as load:
        child = subprocess.Popen(command)
        time.sleep(1.0)
    child.kill()
    child.wait()
    own = load.cores
    with OtherLoad() as load:
        pid = int(
            subprocess.check_output(["sh", "-c", '"$@" >/dev/null & echo $!', "sh", *command])
        )
        time.sleep(1.0)
    os.kill(pid, 9)
    assert load.cores > own + FREE
    assert load.more_than(FREE) == f"others took {load.cores:.2f} of {os.cpu_count()} cores"
    assert load.more_than(load.cores) == ""


@pytest.mark.thorough
def test_second_core_gains_nothing_where_there_is_one():
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        assert second_core_gain() < 1.3
    finally:
        os.sched_setaffinity(0, allowed)


FAIL, SKIP = pytest.fail.Exception, pytest.skip.Exception


@pytest.mark.parametrize(
    ("reached", "others", "disturbed", "outcome", "words"),
    [
        (True, 0.1, "", None, ""),
        (True, 1.0, "", None, ""),
        (True, 0.0, "the second core is half a core", None, ""),
        (True, 1.4, "", SKIP, r"ratio 7: not judged .*, others took 1\.40 of 2 cores"),
        (False, 0.1, "", FAIL, "ratio 7"),
        (False, 0.5, "", SKIP, r"ratio 7: not judged .*, others took 0\.50 of 2 cores"),
        (
            False,
            0.0,
            "the second core is half a core",
            SKIP,
            "not judged .*, the second core is half a core",
        ),
    ],
)
def test_goals_are_judged_on_a_free_machine_alone(
    monkeypatch, reached, others, disturbed, outcome, words
):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    load = OtherLoad()
    load.cores = others
    if outcome is None:
        judge(reached, "ratio 7", load, disturbed)
    else:
        with pytest.raises(outcome, match=words):
            judge(reached, "ratio 7", load, disturbed)
