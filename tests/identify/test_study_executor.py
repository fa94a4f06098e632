"""Batches on workers that die, with a client that plays Dask: nothing waits without a limit, and no row is blamed for
one death."""

from types import SimpleNamespace

import pytest
from distributed import KilledWorker

from identify.errors import StudyError
from identify.studies import dask_cluster as dask_executor
from identify.studies.dask_cluster import DaskExecutor
from identify.studies.design import Case, Finished
from identify.studies.runner import Batches

LOST = TimeoutError("its worker died with the result")
DIED = KilledWorker("task", SimpleNamespace(address="tcp://a:1"), 0)


class Future:
    """A batch that is done at once, and whose result comes in the given steps: an error each, or what is found."""

    def __init__(self, key, steps):
        self.key, self._steps = key, steps

    def add_done_callback(self, action):
        action(self)

    def result(self, timeout=None):
        assert timeout is not None, "waits without a limit"
        step = next(self._steps)
        if isinstance(step, Exception):
            raise step
        return step


class Client:
    """A client of a cluster with so many workers; `steps(cases, time)`: results of a batch sent the so many-th time."""

    status = "running"

    def __init__(self, steps, workers=1):
        self._steps, self._workers, self.sent = steps, workers, []

    def submit(self, _, version, setup, cases, key, pure):
        numbers = [case.number for case in cases]
        self.sent.append(numbers)
        return Future(key, iter(self._steps(numbers, self.sent.count(numbers))))

    def nthreads(self, callback_timeout=None):
        assert callback_timeout is not None, "waits without a limit"
        return dict.fromkeys(range(self._workers), 1)


def found(numbers):
    return [Finished(number, {}, 0.0) for number in numbers]


def computed(client, rows):
    cases = (Case(number, 0, {}) for number in range(rows))
    return {row.number: row.error for batch in DaskExecutor(client)(None, Batches(cases, rows)) for row in batch}


def forever(step):
    while True:
        yield step


def test_result_that_died_with_its_worker_is_waited_for_and_noted_once():
    client = Client(lambda numbers, _: [LOST, LOST, found(numbers)])
    assert computed(client, 3) == {0: "", 1: "", 2: ""}
    assert client.sent == [[0], [1], [2]]


def test_result_that_died_with_the_last_worker_ends_the_study_in_one_line(monkeypatch):
    monkeypatch.setattr(dask_executor, "WORKERLESS_SECONDS", 0.05)
    with pytest.raises(StudyError, match=r"^no Dask worker for 0.05 s; the same command goes on from here$"):
        computed(Client(lambda *_: forever(LOST), workers=0), 1)


def test_scheduler_that_does_not_answer_ends_the_study_in_one_line(monkeypatch):
    client = Client(lambda numbers, _: [found(numbers)])

    def no_answer(callback_timeout):
        raise TimeoutError(f"timed out after {callback_timeout} s")

    monkeypatch.setattr(client, "nthreads", no_answer)
    with pytest.raises(StudyError, match=r"^the Dask scheduler is gone; .* timed out after \d+ s$"):
        computed(client, 1)


def test_row_is_blamed_for_the_second_death_of_its_worker_and_not_for_the_first():
    deaths = {0: 1, 1: 9}
    client = Client(lambda numbers, time: [DIED if time <= deaths.get(numbers[0], 0) else found(numbers)])
    errors = computed(client, 3)
    assert client.sent == [[0], [1], [2], [1], [0]]
    assert (errors[0], errors[2]) == ("", "")
    assert errors[1].startswith("KilledWorker: ")


def test_row_that_is_the_only_one_is_tried_again_too():
    client = Client(lambda numbers, time: [DIED if time == 1 else found(numbers)])
    assert computed(client, 1) == {0: ""}
    assert client.sent == [[0], [0]]
