"""Studies on clusters: the numbers of one process, whoever dies in the middle; no row is blamed for
one death.
"""

import json
import signal
import subprocess
from collections import Counter
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import dask
import numpy as np
import pytest
from distributed import KilledWorker

from identify.errors import StudyError
from identify.files.versions import OtherVersionsWarning, versions
from identify.progress import SilentProgress
from identify.studies import dask_cluster
from identify.studies.dask_cluster import DaskExecutor, running_cluster
from identify.studies.runner import Batches, run_study
from identify.studies.study_design import Case, Finished
from tests.identify.study_rows import (
    ROOT,
    at,
    journal,
    many_rows,
    process,
    same_numbers,
    wait_for,
)

LOST = TimeoutError("its worker died with the result")
DIED = KilledWorker("task", SimpleNamespace(address="tcp://a:1"), 0)


def found(numbers):
    return [Finished(number, {}, 0.0) for number in numbers]


def computed(steps, rows, **changes):
    """Errors of rows by number, and the batches as sent, on a cluster of one worker that does a
    batch at once.

    steps(numbers, time): results of a batch sent the so many-th time, one after the other: an
    error, or what is found.
    """

    def submit(_, version, setup, cases, pure):
        sent.append([case.number for case in cases])
        result = Mock(side_effect=steps(sent[-1], sent.count(sent[-1])))
        # waits with a limit
        future = SimpleNamespace(key=len(sent), result=lambda timeout: timeout and result())
        future.add_done_callback = lambda action: action(future)
        return future

    sent, cases = [], (Case(number, 0, {}) for number in range(rows))
    client = {
        "status": "running",
        "submit": submit,
        "nthreads": lambda callback_timeout: {"tcp://a:1": 1},
    }
    batches = DaskExecutor(SimpleNamespace(**client | changes))(None, Batches(cases, rows))
    return {row.number: row.error for batch in batches for row in batch}, sent


def test_result_that_died_with_its_worker_is_waited_for_and_noted_once():
    assert computed(lambda numbers, _: [LOST, LOST, found(numbers)], 3) == (
        {0: "", 1: "", 2: ""},
        [[0], [1], [2]],
    )


def test_last_worker_or_a_scheduler_that_does_not_answer_ends_the_study_in_one_line(monkeypatch):
    monkeypatch.setattr(dask_cluster, "WORKERLESS_SECONDS", 0.05)
    with pytest.raises(
        StudyError, match=r"^no Dask worker for 0.05 s; the same command continues the study$"
    ):
        computed(lambda *_: iter(lambda: LOST, None), 1, nthreads=lambda callback_timeout: {})
    with pytest.raises(StudyError, match=r"^the Dask scheduler is gone; .* timed out$"):
        computed(
            lambda numbers, _: [found(numbers)],
            1,
            nthreads=Mock(side_effect=TimeoutError("timed out")),
        )


def test_row_is_blamed_for_the_second_death_of_its_worker_and_not_for_the_first():
    for rows, deaths, expected in (
        (3, {0: 1, 1: 9}, [[0], [1], [2], [1], [0]]),
        (1, {0: 1}, [[0], [0]]),
    ):
        errors, sent = computed(
            lambda sent, time, deaths=deaths: [
                DIED if time <= deaths.get(sent[0], 0) else found(sent)
            ],
            rows,
        )
        assert sent == expected
        assert [number for number, error in errors.items() if error] == [1] * (rows > 1)
        assert all(error.startswith("KilledWorker: ") for error in errors.values() if error)


def worker(address, folder, before=ROOT, host="127.0.0.1"):
    options = ("--no-nanny", "--nthreads", 1, "--no-dashboard", "--local-directory", folder)
    options += ("--host", host)
    return process("distributed.cli.dask_worker", address, *options, before=before)


def other_versions(folder, **packages):
    """A folder that makes a process believe that it has these versions of packages."""
    for name, version in packages.items():
        metadata = folder / f"{name}-{version}.dist-info" / "METADATA"
        metadata.parent.mkdir(parents=True)
        metadata.write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return folder


@contextmanager
def cluster(folder, workers, before=ROOT, protocol="tcp"):
    """A scheduler and workers, each a process of its own: address, scheduler, workers; `before`:
    see `process`.
    """
    file = folder / "scheduler.json"
    place = ("--protocol", protocol, "--host", "127.0.0.1", "--port", 0)
    options = (*place, "--no-dashboard", "--scheduler-file", file)
    scheduler, there = process("distributed.cli.dask_scheduler", *options), []
    try:
        wait_for(lambda: file.exists() and file.read_text().endswith("}"), "scheduler")
        address = json.loads(file.read_text())["address"]
        there += [worker(address, folder, before) for _ in range(workers)]
        yield address, scheduler, there
    finally:
        for one in [scheduler, *there]:
            one.kill()
            one.communicate()


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    """The table of the study, computed in this process."""
    return run_study(
        many_rows(seconds=0.0), tmp_path_factory.mktemp("serial") / "a", SilentProgress()
    ).frame


@pytest.mark.thorough
def test_workers_that_die_and_one_that_comes_change_no_number_and_other_packages_are_one_warning(
    tmp_path, serial
):
    """After two thirds of the rows both first workers are dead, so that one on another address,
    which came after a third, computes the rest."""
    log, there = tmp_path / "log", other_versions(tmp_path / "there", numpy="1.2.3", casadi="0.1")
    place = r"\(worker tcp://\S+( and [12] more)?\), here"
    said = rf"numpy 1.2.3 {place} {np.__version__}; casadi 0.1 {place}"
    with cluster(tmp_path, 2, there) as (address, _, workers):
        workers_there = partial(running_cluster, address)

        def exchange():
            workers[0].kill()
            workers.append(worker(address, tmp_path, there, host="127.0.0.2"))

        steps = iter([exchange, workers[1].kill])
        progress = at(lambda: next(steps)(), 40, 80)
        with pytest.warns(OtherVersionsWarning, match=said) as caught:
            outcome = run_study(many_rows(log=str(log)), tmp_path / "a", progress, workers_there)
        assert [one.wait(10) for one in workers[:2]] == 2 * [-signal.SIGKILL]
        assert workers[2].poll() is None
    same_numbers(outcome.frame, serial)
    assert sorted(journal(tmp_path / "a")) == list(range(120))
    again = [number for number, times in Counter(log.read_text().split()).items() if times > 1]
    assert len(again) <= 2 * 3 * 15, "more than the batches that the dead workers had"
    assert len(caught) == 1


@pytest.mark.thorough
def test_lost_scheduler_is_one_line_and_the_study_goes_on_with_another(tmp_path, serial):
    with (
        cluster(tmp_path, workers=1) as (address, scheduler, _),
        pytest.raises(StudyError) as caught,
    ):
        run_study(
            many_rows(), tmp_path / "a", at(scheduler.kill, 30), partial(running_cluster, address)
        )
    assert "\n" not in str(caught.value)
    assert "scheduler is gone" in str(caught.value)
    kept = len(journal(tmp_path / "a"))
    assert 30 <= kept < 120
    outcome = run_study(many_rows(), tmp_path / "a", SilentProgress())
    assert outcome.found == kept
    same_numbers(outcome.frame, serial)


@pytest.mark.thorough
def test_worker_with_another_version_of_the_product_is_refused_at_the_start_and_later(tmp_path):
    there, here = other_versions(tmp_path / "there", cmmsim="9.8.7"), versions()["cmmsim"]
    refusal = (
        rf"^worker tcp://\S+ has cmmsim 9\.8\.7, but this process has {here}; install \S[^\n]*$"
    )
    with cluster(tmp_path, 1) as (address, _, workers):
        workers_there = partial(running_cluster, address)
        come = at(lambda: workers.append(worker(address, tmp_path, there)), 1)
        with pytest.raises(StudyError, match=refusal):
            run_study(many_rows(seconds=0.5), tmp_path / "a", come, workers_there)
        assert 1 <= len(journal(tmp_path / "a")) < 120
        with pytest.raises(StudyError, match=refusal):
            run_study(many_rows(), tmp_path / "b", SilentProgress(), workers_there)
    assert not (tmp_path / "b").exists()


@pytest.mark.slow
def test_worker_that_lacks_the_product_is_named(tmp_path):
    (tmp_path / "there" / "identify").mkdir(parents=True)
    (tmp_path / "there" / "identify" / "__init__.py").write_text("raise ImportError('none here')\n")
    message = r"worker tcp://\S+ cannot run cmmsim \S+: ImportError\('none here'\)$"
    with (
        cluster(tmp_path, 1, tmp_path / "there") as (address, _, _),
        pytest.raises(StudyError, match=message),
    ):
        run_study(many_rows(), tmp_path / "a", SilentProgress(), partial(running_cluster, address))


@pytest.fixture
def certificate(tmp_path):
    """A function that makes a certificate, and names it to Dask in this process and its own."""

    def make(name, monkeypatch):
        key, cert = (tmp_path / f"{name}_{kind}.pem" for kind in ("key", "cert"))
        what = ("-x509", "-newkey", "rsa:3072", "-nodes", "-days", "365", "-subj", "/CN=cmmsim")
        command = ["openssl", "req", *what, "-keyout", str(key), "-out", str(cert)]
        subprocess.run(command, check=True, capture_output=True)
        entries = {"comm.tls.ca-file": cert}
        for side in ("scheduler", "worker", "client"):
            entries |= {f"comm.tls.{side}.cert": cert, f"comm.tls.{side}.key": key}
        for entry, path in entries.items():
            name = entry.upper().replace(".", "__").replace("-", "_")
            monkeypatch.setenv(f"DASK_DISTRIBUTED__{name}", str(path))
        monkeypatch.setenv("DASK_DISTRIBUTED__COMM__REQUIRE_ENCRYPTION", "true")
        return dask.config.set(
            {f"distributed.{entry}": str(path) for entry, path in entries.items()}
        )

    return make


@pytest.mark.thorough
def test_a_scheduler_with_certificates_takes_a_study_with_the_same_one_and_no_other(
    tmp_path, certificate, monkeypatch, serial
):
    """The certificates are made as docs/howto/studies.md says."""

    def run(address, folder):
        workers = partial(running_cluster, address)
        return run_study(many_rows(), tmp_path / folder, SilentProgress(), workers).frame

    with certificate("ours", monkeypatch), cluster(tmp_path, 1, protocol="tls") as (address, *_):
        assert address.startswith("tls://")
        same_numbers(run(address, "a"), serial)
        with (
            pytest.raises(StudyError, match=r"^no Dask scheduler answers at [^\n]*$"),
            certificate("strangers", monkeypatch),
        ):
            run(address, "b")
        with (
            pytest.raises(StudyError, match=r"^no Dask scheduler answers at [^\n]*$"),
            dask.config.set({"distributed.comm.require-encryption": False}),
        ):
            run(address.replace("tls", "tcp"), "c")


@pytest.mark.slow
def test_a_scheduler_that_anybody_can_speak_to_is_refused_unless_that_is_wanted(monkeypatch):
    monkeypatch.setattr(dask_cluster, "CONNECT_SECONDS", 0.2)
    for address in ("tcp://192.0.2.1:8786", "192.0.2.1:8786", "tcp://[2001:db8::1]:8786"):
        for insecure, why in (
            (False, r"\S+ asks for no certificate: .* use --insecure"),
            (True, "no"),
        ):
            with (
                pytest.raises(StudyError, match=rf"^{why}[^\n]*$"),
                running_cluster(address, insecure),
            ):
                pass
    for address in ("tcp://127.0.0.1:1", "tcp://localhost:1", "tcp://[::1]:1"):
        with pytest.raises(StudyError, match=r"^no Dask [^\n]*$"), running_cluster(address):
            pass
    with (
        pytest.raises(StudyError, match=r"^tls://\S+ asks for certificates \(none [^\n]*$"),
        running_cluster("tls://192.0.2.1:8786"),
    ):
        pass
    with (
        dask.config.set({"distributed.comm.tls.ca-file": "/none"}),
        pytest.raises(StudyError, match=r"^tls://\S+ asks for certificates [^\n]*$"),
        running_cluster("tls://192.0.2.1:8786"),
    ):
        pass
