"""Versions on the workers of a cluster, as they answer; real workers are in `test_study_cluster`."""

import warnings

import pytest

from identify.errors import StudyError
from identify.files.versions import versions
from identify.studies.worker_versions import OtherVersionsWarning, check_workers


def answer(**changes):
    return versions() | changes


def test_workers_as_here_are_no_news():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_workers({"tcp://a:1": answer(), "tcp://b:1": answer()})


@pytest.mark.parametrize(
    ("there", "evidence"),
    [
        (answer(cmmsim="9.8.7"), f"worker tcp://b:1 has cmmsim 9.8.7, here is {versions()['cmmsim']}"),
        (answer(cmmsim="not installed"), "worker tcp://b:1 has cmmsim not installed, here is"),
        (Exception("ImportError('none\\nhere')\n"), "worker tcp://b:1 cannot run cmmsim"),
    ],
)
def test_another_product_is_refused_in_one_line(there, evidence):
    with pytest.raises(StudyError) as caught:
        check_workers({"tcp://a:1": answer(numpy="0.1"), "tcp://b:1": there})
    assert evidence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_one_warning_names_each_version_once_with_how_many_workers_have_it():
    there = {f"tcp://{name}:1": answer(numpy="1.2.3") for name in "abc"} | {"tcp://d:1": answer(casadi="3.0")}
    with pytest.warns(OtherVersionsWarning) as caught:
        check_workers(there)
    here = versions()
    assert [str(one.message) for one in caught] == [
        f"figures may differ a little where versions do: numpy 1.2.3 on tcp://a:1 and 2 more, here {here['numpy']}; "
        f"casadi 3.0 on tcp://d:1, here {here['casadi']}"
    ]


def test_worker_that_died_meanwhile_does_not_matter():
    check_workers({"tcp://a:1": answer(), "tcp://b:1": OSError("closed")})
