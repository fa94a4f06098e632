"""Number of threads in which runs of a model are computed."""

import threading

import pytest

from identify.runtime import cores, in_threads, threads


def test_one_thread_is_that_of_the_caller(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    used = set(in_threads(lambda _: threading.get_ident(), range(4)))
    assert used == {threading.get_ident()}


@pytest.mark.parametrize("value", ["", "0", "1", "1000", "true"])
def test_any_value_of_the_variable_gives_from_one_thread_to_one_per_core(monkeypatch, value):
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert 1 <= threads() <= cores()


def test_results_keep_the_order_of_the_items(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert list(in_threads(lambda item: item**2, range(20))) == [item**2 for item in range(20)]
