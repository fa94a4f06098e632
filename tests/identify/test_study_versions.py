"""One study, one version: of the workers of a cluster, as they answer, and of rows that a folder has already.

Real workers are in `test_study_cluster`.
"""

import json
import warnings

import pytest

from identify.errors import StudyError
from identify.files.versions import OtherVersionsWarning, versions
from identify.progress import SilentProgress
from identify.studies.dask_cluster import check_workers
from identify.studies.runner import run_study
from identify.studies.store import JOURNAL, STUDY
from identify.studies.study_file import Study
from tests.identify.study_rows import KIND


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
        "figures may differ a little where versions do: numpy 1.2.3 (worker tcp://a:1 and 2 more), here "
        f"{here['numpy']}; casadi 3.0 (worker tcp://d:1), here {here['casadi']}"
    ]


def test_worker_that_died_meanwhile_does_not_matter():
    check_workers({"tcp://a:1": answer(), "tcp://b:1": OSError("closed")})


def run(folder, repeats):
    factors = {"sensor.camera.dark_noise": [13.0, 26.0]}
    return run_study(Study(name="mine", kind=KIND, factors=factors, repeats=repeats), folder, SilentProgress())


def begun_by(folder, **changes):
    """Say in the folder that other versions began it."""
    entry = json.loads((folder / STUDY).read_text())
    (folder / STUDY).write_text(json.dumps(entry | {"versions": entry["versions"] | changes}))


def test_no_rows_are_added_to_those_of_another_version(tmp_path):
    run(tmp_path, 2)
    begun_by(tmp_path, cmmsim="9.8.7")
    kept = (tmp_path / JOURNAL).read_bytes()
    with pytest.raises(StudyError, match=r"has cmmsim 9\.8\.7, here is \S+; go on with that version"):
        run(tmp_path, 3)
    assert (tmp_path / JOURNAL).read_bytes() == kept
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(tmp_path, 2).found == 4


def test_rows_are_added_with_a_warning_where_only_other_packages_changed(tmp_path):
    run(tmp_path, 1)
    begun_by(tmp_path, scipy="0.1")
    with pytest.warns(OtherVersionsWarning, match=r"scipy 0\.1 \(.*\), here"):
        run(tmp_path, 2)
    assert json.loads((tmp_path / STUDY).read_text())["versions"] == answer(scipy="0.1")


def test_folder_without_rows_is_begun_anew_whatever_version_made_it(tmp_path):
    run(tmp_path, 1)
    (tmp_path / JOURNAL).write_bytes(b"")
    begun_by(tmp_path, cmmsim="9.8.7")
    assert run(tmp_path, 1).found == 0
    assert json.loads((tmp_path / STUDY).read_text())["versions"] == versions()


def test_folder_that_says_no_versions_goes_on(tmp_path):
    run(tmp_path, 1)
    entry = json.loads((tmp_path / STUDY).read_text())
    del entry["versions"]
    (tmp_path / STUDY).write_text(json.dumps(entry))
    assert run(tmp_path, 2).found == 2
